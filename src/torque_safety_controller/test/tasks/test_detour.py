# SPDX-License-Identifier: Apache-2.0
"""When an arm is led, where to, and when that ends."""

import numpy as np
import pinocchio as pin
import pytest
from arms import load_arm
from searches import finished

from torque_safety_controller.qp.constraints import AccelerationRange
from torque_safety_controller.tasks.detour import (
    ATTEMPTS,
    FARTHEST,
    HELD,
    LONGEST_REST,
    WORK,
    Detour,
    Progress,
)
from torque_safety_controller.tasks.detour_search import COMFORT, SLOPE, DetourSearch, Goal
from torque_safety_controller.tasks.pose_task import PoseTask
from torque_safety_controller.tasks.posture_search import COST
from torque_safety_controller.tasks.posture_task import PostureTask
from torque_safety_controller.tasks.standstill import LOOKED_AT, PATIENCE, SHORT
from torque_safety_controller.tasks.way_task import WayTask
from viability_bounds_pkg.state import State
from viability_bounds_pkg.testing.ros_harness import read_config
from viability_bounds_pkg.whole_arm.safety_filter import SafetyFilter

ARM = load_arm("baxter_left_arm")
A_MAX = np.array(read_config("baxter_left_arm", "controller_node")["acceleration_max"])
REST = np.zeros(ARM.n)
KP, KD = 100.0, 20.0
EDGE = np.array([0.0, -0.64, 0.0, 0.0, 0.0, 0.0, 0.0])
"""Where Baxter's shoulder, the elbow straight, needs 96% of its torque."""
BELOW = np.array([0.0, 0.9, 0.0, 0.0, 0.0, 0.0, 0.0])
"""On the other side of what it cannot hold."""
STRETCHED = np.array([0.0, -0.2, 0.0, 0.0, 0.0, 0.0, 0.0])
PATIENT = round(PATIENCE / ARM.dt)


class Arm:
    """An arm that is where it is put, and its detour."""

    def __init__(self, goal=BELOW, pose=None):
        self.keeper = SafetyFilter(
            ARM.model, ARM.q_min, ARM.q_max, -A_MAX, A_MAX, ARM.tau_max, ARM.dt
        )
        self.asked = 0
        self.robot = ARM.robot()
        search = DetourSearch(self.robot, ARM.q_min, ARM.q_max, ARM.tau_max, self.can_hold)
        self.detour = Detour(search, ARM.dt)
        self.given = [PostureTask(goal, KP, KD, 1.0)]
        if pose is not None:
            self.given = [PoseTask(pose, KP, KD, 1.0), PostureTask(goal, 10.0, 6.0, 1e-3, True)]

    def can_hold(self, q):
        self.asked += 1
        return self.keeper.can_hold(q)

    def step(self, q=EDGE, v=REST, a_last=REST, bounds=None):
        self.robot.update(State(q, v), a_last)
        return self.detour.tasks(self.given, self.robot, bounds)

    def stand(self, steps, **state):
        for _ in range(steps):
            tasks = self.step(**state)
        return tasks

    def wait_for(self, progress, q=EDGE):
        for _ in range(3000):
            tasks = self.step(q)
            if self.detour.progress is progress:
                return tasks
        raise AssertionError(f"{self.detour.progress}, not {progress}")

    def follow(self, q=EDGE):
        """Be where the arm is led, until it is there; return the postures."""
        passed = []
        for _ in range(3000):
            tasks = self.step(q)
            if self.detour.progress is not Progress.LED:
                return passed, tasks
            assert len(tasks) == 1
            step = np.clip(tasks[0].q_des - q, -0.02, 0.02)
            q = q + step
            passed.append(q)
        raise AssertionError("the way has no end")


def test_an_arm_that_stands_is_led_where_it_can_be_held():
    arm = Arm()
    assert arm.stand(PATIENT) is arm.given
    assert arm.detour.progress is Progress.NONE
    arm.wait_for(Progress.LED)
    passed, tasks = arm.follow()
    assert tasks is arm.given
    np.testing.assert_allclose(passed[-1], BELOW, atol=0.03)
    assert np.max(passed, axis=0)[3] > 0.3, "the elbow did not bend"
    assert all(arm.keeper.can_hold(q) for q in passed[15:])


def test_for_a_pose_it_is_led_to_a_posture_that_is_then_kept():
    data = ARM.model.createData()
    pin.framesForwardKinematics(ARM.model, data, BELOW)
    pose = data.oMf[ARM.model.getFrameId(ARM.frame)].copy()
    arm = Arm(ARM.q_start, pose)
    arm.wait_for(Progress.LED)
    passed, tasks = arm.follow()
    assert tasks[0] is arm.given[0]
    q = tasks[1].q_des
    pin.framesForwardKinematics(ARM.model, data, q)
    error = pin.log6(data.oMf[ARM.model.getFrameId(ARM.frame)].actInv(pose)).vector
    assert np.abs(error).max() < 1e-4  # m, rad
    np.testing.assert_allclose(passed[-1], q, atol=SHORT)
    assert tasks[1].in_null_space
    assert arm.keeper.can_hold(q)


@pytest.mark.parametrize(
    "state",
    [
        {"q": BELOW + 0.9 * SHORT},
        {"a_last": 0.5 * KP * (BELOW - EDGE)},  # somebody holds it: the QP would let it go on
    ],
)
def test_it_is_not_led_where_it_is_there_or_is_held(state):
    arm = Arm()
    assert arm.stand(20 * PATIENT, **state) is arm.given
    assert arm.detour.progress is Progress.NONE


def swing(arm, seconds, given=0.0):
    """Move to and fro by 5 mrad, faster than an arm that stands; return when it is led, s."""
    w, size = 20.0, 0.005
    for k in range(round(seconds / ARM.dt)):
        t = k * ARM.dt
        q = EDGE + size * np.sin(w * t)
        v, a = np.full(ARM.n, size * w * np.cos(w * t)), -size * w * w * np.sin(w * t)
        held = KP * (BELOW - q) - KD * v
        tasks = arm.step(q, v, given * held + (1.0 - given) * a)
        if arm.detour.progress is not Progress.NONE:
            return t, tasks
    return None


def test_an_arm_that_moves_to_and_fro_is_stopped_and_led():
    arm = Arm()
    t, tasks = swing(arm, 3.0)
    assert LOOKED_AT - 1e-9 < t < LOOKED_AT + 0.5
    np.testing.assert_allclose(tasks[0].q_des, EDGE, atol=0.01)  # while a way is searched for
    arm.wait_for(Progress.LED)
    passed, _ = arm.follow()
    np.testing.assert_allclose(passed[-1], BELOW, atol=0.03)


def test_an_arm_that_moved_is_not_held_for_a_long_search():
    arm = Arm()

    def endless(q, goal, rng):
        arm.detour._ways.reached = True
        while True:
            yield 1

    arm.detour._ways.ways = endless
    for longest in (HELD, 2.0 * HELD):
        _, tasks = swing(arm, 3.0)
        assert tasks is not arm.given
        held = 1
        while arm.step() is not arm.given:
            held += 1
            assert held * ARM.dt < longest + 0.1
        assert held * ARM.dt > longest - 0.1
        assert arm.detour.progress is Progress.NONE


def test_attempts_may_go_on_for_days():
    arm = Arm()
    arm.step()
    arm.detour._attempts = 5000
    assert swing(arm, 3.0) is not None  # it is held for a search
    arm.detour._end_attempt()
    assert arm.detour.progress is Progress.NO_WAY
    assert arm.detour._rest == LONGEST_REST


def test_an_arm_that_somebody_shakes_is_not_led():
    assert swing(Arm(), 3.0, given=0.5) is None


def test_an_arm_that_comes_nearer_slowly_is_not_led():
    arm, speed = Arm(), 0.1  # rad/s
    for k in range(round(3.0 / ARM.dt)):
        done = speed * k * ARM.dt / np.abs(BELOW - EDGE).max()
        arm.step(EDGE + done * (BELOW - EDGE), speed / 1.54 * (BELOW - EDGE))
        assert arm.detour.progress is Progress.NONE


def test_a_goal_beyond_a_position_limit_is_told():
    goal = BELOW + 0.004 * np.eye(ARM.n)[6]
    arm = Arm(goal)
    stopped = AccelerationRange(-np.full(ARM.n, 5.0), np.full(ARM.n, 5.0))
    stopped.upper[6] = 0.0
    assert arm.stand(2 * PATIENT, q=BELOW, bounds=stopped) is arm.given
    assert arm.detour.progress is Progress.AT_LIMIT
    np.testing.assert_allclose(arm.detour.short, goal - BELOW, atol=1e-12)
    stopped.upper[6] = 5.0
    seen = set()
    for _ in range(2 * PATIENT):
        arm.step(BELOW, bounds=stopped)
        seen.add(arm.detour.progress)
    assert Progress.LED in seen


@pytest.mark.parametrize("seed", range(3))
def test_ways_lead_away_from_the_edge_of_what_can_be_held(seed):
    arm = Arm()
    search = DetourSearch(arm.robot, ARM.q_min, ARM.q_max, ARM.tau_max, arm.can_hold)
    way, _ = finished(search.ways(EDGE, Goal(None, BELOW), np.random.default_rng(seed)))
    load, ends = lambda q: np.abs(search.load(q)).max(), (EDGE, BELOW)
    assert load(EDGE) > 0.95
    for a, b in zip(way, way[1:], strict=False):
        for q in np.linspace(a, b, 20):
            most = max(load(end) - SLOPE * np.abs(q - end).max() for end in ends)
            assert load(q) < max(most, 1.0 - COMFORT) + 0.01  # between what was looked at


def test_without_stiffness_it_is_not_led():
    arm = Arm()
    arm.given[0].kp = 0.0
    assert arm.stand(20 * PATIENT) is arm.given


def test_a_goal_that_cannot_be_held_is_told_and_not_searched_for():
    arm = Arm(STRETCHED)
    assert arm.stand(2 * PATIENT) is arm.given
    assert arm.detour.progress is Progress.NOT_HELD
    assert arm.detour.load.argmax() == 1
    assert arm.detour.load[1] * ARM.tau_max[1] > 50.0  # N m
    asked = arm.asked
    arm.stand(10)
    assert arm.asked == asked


def test_a_step_does_no_more_work_than_it_may():
    arm = Arm()
    arm.stand(PATIENT + 1)
    most = []
    while arm.detour.progress is not Progress.LED:
        before = arm.asked
        arm.step()
        most.append(arm.asked - before)
    assert len(most) > 3
    assert max(most) <= WORK * ARM.dt + COST


def test_another_goal_is_begun_with_and_the_same_one_is_not():
    arm = Arm()
    arm.wait_for(Progress.LED)
    arm.given = [PostureTask(BELOW.copy(), KP, KD, 1.0)]
    assert arm.step() is not arm.given
    arm.given = [PostureTask(BELOW + 0.01, KP, KD, 1.0)]
    assert arm.step() is arm.given
    assert arm.detour.progress is Progress.NONE


def test_other_ways_are_tried_where_the_arm_does_not_follow_ever_less_often():
    arm = Arm()
    arm.wait_for(Progress.LED)
    led, before = 1, Progress.LED
    for _ in range(3000):
        arm.step()
        led += arm.detour.progress is Progress.LED is not before
        before = arm.detour.progress
        if before is Progress.NO_WAY:
            break
        assert np.abs(arm.detour.lead - EDGE).max() <= FARTHEST
    assert led == ATTEMPTS
    rests = []
    for _ in range(3):
        rests.append(0)
        while arm.detour.progress is Progress.NO_WAY:
            assert arm.step() is arm.given
            rests[-1] += 1
        arm.wait_for(Progress.NO_WAY)
    assert rests[0] < rests[1] < rests[2]


@pytest.mark.parametrize(
    ("q", "closely"), [(BELOW - [0.4, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0], True), (EDGE, False)]
)
def test_an_arm_that_left_a_straight_way_is_kept_to_it(q, closely):
    """On a way with corners other ways are tried instead."""
    arm, followed = Arm(), []
    for _ in range(2):
        followed.append(type(arm.wait_for(Progress.LED, q)[0]))
        while arm.detour.progress is Progress.LED:
            arm.step(q)
    assert followed == [PostureTask, WayTask if closely else PostureTask]
