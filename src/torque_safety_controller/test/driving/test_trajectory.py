# SPDX-License-Identifier: Apache-2.0
"""Trajectories of the joints: between points, at their ends, from a state, refused."""

from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pinocchio as pin
import pytest
from scipy.interpolate import BPoly

from torque_safety_controller.driving.trajectory import (
    JointMotion,
    JointPoint,
    JointTrajectory,
    JointTrajectoryError,
    TrajectoryMotion,
    TrajectoryPassed,
)
from viability_bounds_pkg.pose_trajectory import PoseTrajectory, TrajectoryPoint
from viability_bounds_pkg.state import State

RNG = np.random.default_rng(3)
TIMES = np.cumsum(RNG.uniform(0.2, 1.0, 6))
PARTS = RNG.normal(size=(3, 6, 4))  # q, v, a
DT, KP = 2e-3, 10.0
KD = 2.0 * KP**0.5


@pytest.mark.parametrize("parts", [2, 3])
def test_between_points_it_is_the_polynomial_that_meets_both(parts):
    points = [JointPoint(t, *each) for t, *each in zip(TIMES, *PARTS[:parts], strict=True)]
    trajectory = JointTrajectory(points)
    meant = BPoly.from_derivatives(TIMES, np.stack(PARTS[:parts], axis=1))
    for t in np.linspace(TIMES[0], TIMES[-1] - 1e-9, 50):
        for k, found in enumerate(trajectory.sample(t)):
            np.testing.assert_allclose(found, meant.derivative(k)(t) if k else meant(t), atol=1e-8)


def test_positions_alone_are_joined_without_overshoot_from_rest_to_rest():
    q = np.array([0.0, 1.0, 1.0, 0.2, 0.1])
    trajectory = JointTrajectory([JointPoint(k, q[k : k + 1]) for k in range(5)])
    for k in range(4):
        inside = np.array([trajectory.sample(t)[0][0] for t in np.linspace(k, k + 1, 30)])
        assert inside.min() > min(q[k : k + 2]) - 1e-12
        assert inside.max() < max(q[k : k + 2]) + 1e-12
    for t in (0.0, 4.0 - 1e-9):
        assert abs(trajectory.sample(t)[1][0]) < 1e-6


def test_it_begins_at_the_state_and_stays_at_its_end():
    points = [JointPoint(t, *each) for t, *each in zip(TIMES, *PARTS, strict=True)]
    state = State(np.full(4, 0.3), np.full(4, -0.2))
    trajectory = JointTrajectory(points).from_state(state)
    q, v, _ = trajectory.sample(0.0)
    np.testing.assert_allclose((q, v), state)
    q, v, a = trajectory.sample(TIMES[-1] + 1.0)
    np.testing.assert_array_equal(q, PARTS[0, -1])
    assert not v.any() and not a.any()


@pytest.mark.parametrize("first", [0.0, 0.5])
def test_continuous_joints_go_to_the_nearest_turn_of_the_first_point(first):
    q = np.array([[0.1, 0.1], [0.3, 0.3]])
    points = [JointPoint(first + k, q[k]) for k in range(2)]
    state = State(np.array([2.0 * np.pi, 2.0 * np.pi]), np.zeros(2))
    moved = JointTrajectory(points).from_state(state, np.array([True, False]))
    for k in range(2):
        np.testing.assert_allclose(
            moved.sample(first + k)[0], q[k] + [2.0 * np.pi, 0.0], atol=1e-12
        )


@pytest.mark.parametrize(
    ("points", "reason"),
    [
        ([], "points is empty"),
        ([(0.5, [0.0]), (0.5, [1.0])], r"points\[1\].time is 0.5; allowed: more than 0.5"),
        ([(-0.5, [0.0])], r"points\[0\].time is -0.5"),
        ([(0.5, [0.0]), (1.0, [np.nan])], r"points\[1\] is not finite"),
        ([(0.5, [0.0]), (1.0, [1.0], [0.0])], r"points\[1\] has other parts"),
        ([(0.5, [0.0]), (0.5 + 1e-6, [1.0])], "faster than 1000 rad/s"),
        ([(0.5, [0.0], [1e308]), (1.0, [1.0], [-1e308])], "faster than 1000 rad/s"),
    ],
)
def test_refused(points, reason):
    with pytest.raises(JointTrajectoryError, match=reason), np.errstate(all="ignore"):
        JointTrajectory([JointPoint(t, *map(np.array, parts)) for t, *parts in points])


# Late ones

LATE = [(0.2, 0.0, ""), (3.0, None, ""), (3.0, 0.0, "away from"), (8.0, None, "has ended")]


def refused(why):
    return pytest.raises(TrajectoryPassed, match=why) if why else nullcontext()


@pytest.mark.parametrize(("late", "q", "why"), LATE)
def test_a_late_one_is_joined_only_where_the_joints_are(late, q, why):
    points = [JointPoint(t, np.array([q]), np.zeros(1)) for t, q in ((2.0, 0.9), (6.0, 1.2))]
    trajectory = JointTrajectory(points)
    at = trajectory.sample(late)[0] + 0.05 if q is None else np.array([q])
    with refused(why):
        trajectory.check_late(late, State(at, np.zeros(1)))


@pytest.mark.parametrize(("late", "x", "why"), LATE)
def test_a_late_one_is_joined_only_where_the_hand_is(late, x, why):
    places = ((0.0, 0.0), (2.0, 0.9), (6.0, 1.2))
    points = [
        TrajectoryPoint(t, pin.SE3(np.eye(3), np.array([x, 0.0, 0.0])), np.zeros(6), np.zeros(6))
        for t, x in places
    ]
    trajectory, at = PoseTrajectory(points), pin.SE3.Identity()
    if x is None:
        at.translation = trajectory.sample(late)[0].translation + 0.02
    controller = SimpleNamespace(robot=SimpleNamespace(pose=at))
    begin = 10**9
    with refused(why):
        TrajectoryMotion(trajectory, begin, DT).check_late(
            controller, State(np.zeros(1), np.zeros(1)), begin + round(1e9 * late)
        )


# They wait for the arm


class Joints:
    """Two joints that accelerate as the posture task asks, and can be braked or put elsewhere."""

    robot = SimpleNamespace(model=SimpleNamespace(names=["universe", "a", "b"]))
    goals = property(lambda self: self)

    def __init__(self, goal, duration, begin=0):
        self.q, self.v, self.stamp = np.zeros(2), np.zeros(2), 10**9
        self.goal, self.braked = None, False
        trajectory = JointTrajectory([JointPoint(duration, np.array(goal))])
        limit = np.full(2, 10.0)
        self.motion = JointMotion(trajectory, begin, DT, -limit, limit, limit)

    def release_pose(self):
        pass

    def set_posture(self, *goal):
        self.goal = goal

    def run(self, duration):
        """Move for a time; return goals and speeds, shape (k, 2) each, and whether it ended."""
        goals, speeds, ended = [], [], False
        for _ in range(round(duration / DT)):
            ended = not self.motion.advance(self, State(self.q, self.v), self.stamp)
            q, v, a = self.goal
            rate = np.zeros(2) if self.braked else KP * (q - self.q) + KD * (v - self.v) + a
            self.q, self.v = self.q + DT * self.v, self.v + DT * rate
            self.v = self.v * (not self.braked)
            self.stamp += round(1e9 * DT)
            goals.append(q)
            speeds.append(self.v)
        return np.array(goals), np.array(speeds), ended


def test_an_arm_that_follows_gets_the_trajectory_in_time():
    arm = Joints([1.2, 0.5], 6.0)
    goals, _, ended = arm.run(6.0 + 2.0 * DT)
    t = np.minimum(DT * np.arange(len(goals))[:, None] / 6.0, 1.0)
    np.testing.assert_allclose(goals, [1.2, 0.5] * (3 * t**2 - 2 * t**3), atol=1e-9)
    assert ended


def test_a_braked_arm_goes_on_from_where_it_stands_as_fast_as_planned():
    arm = Joints([1.2, 0.5], 6.0)
    arm.run(2.0)
    arm.braked = True
    goals, _, _ = arm.run(6.0)
    assert np.abs(goals[-1] - arm.q).max() < 0.1 + 1e-9
    assert arm.motion.pace.waits
    arm.braked = False
    _, speeds, ended = arm.run(5.0)
    assert speeds.max() < 1.1 * 1.5 * 1.2 / 6.0  # the fastest of the cubic
    assert ended
    np.testing.assert_allclose(arm.q, [1.2, 0.5], atol=0.02)


def test_a_time_without_answers_does_not_count():
    arm = Joints([1.2, 0.5], 6.0)
    before, _, _ = arm.run(2.0)
    arm.stamp += 3 * 10**9
    after, _, _ = arm.run(DT)
    assert np.abs(after - before[-1]).max() < 0.1 * 1.5 * 1.2 / 6.0 + 1e-9


def test_it_is_lost_where_the_arm_is_pushed_far_aside():
    arm = Joints([1.2, 0.0], 6.0)
    arm.run(2.0)
    arm.q = arm.q + [0.0, 0.45]  # not in the direction of motion: it goes on
    arm.run(DT)
    assert arm.motion.pace.rate == 1.0
    arm.q = arm.q + [0.0, 0.1]
    arm.run(DT)
    assert arm.motion.pace.lost
    assert arm.motion.where(["a", "b"]).startswith("b is 0.5")


class Hand:
    """A hand that is put where a test wants it."""

    def __init__(self):
        self.robot, self.goals = SimpleNamespace(pose=pin.SE3.Identity()), self
        self.goal = None

    def set_pose(self, *goal):
        self.goal = goal


def test_the_hand_is_waited_for_where_it_lags_in_its_direction_only():
    points = [
        TrajectoryPoint(t, pin.SE3(pin.exp3(np.array([0.0, 0.0, t])), np.array([x, 0.0, 0.0])))
        for t, x in ((0.0, 0.0), (1.0, 0.5), (2.0, 1.0))
    ]
    motion, hand = TrajectoryMotion(PoseTrajectory(points), 0, DT), Hand()
    stamps = range(10**9, 6 * 10**9, round(1e9 * DT))
    places = []
    for stamp in stamps:
        motion.advance(hand, State(np.zeros(1), np.zeros(1)), stamp)
        places.append(hand.goal[0].translation[0])
    assert places[-1] < 0.05 + 1e-9  # the hand has not moved
    assert np.abs(hand.goal[1]).max() < 0.02
    pose = hand.goal[0].copy()
    pose.translation = pose.translation + pose.rotation @ [0.0, 0.0, 0.1]
    hand.robot.pose = pose  # beside it, and then as far along as it is
    motion.advance(hand, State(np.zeros(1), np.zeros(1)), stamps[-1] + round(1e9 * DT))
    assert motion.pace.rate == 1.0
    pose.translation = pose.translation + [0.0, 0.0, 0.2]
    motion.advance(hand, State(np.zeros(1), np.zeros(1)), stamps[-1] + round(2e9 * DT))
    assert motion.pace.lost


def test_one_that_begins_far_away_waits_for_the_arm():
    far = pin.SE3(np.eye(3), np.array([0.4, 0.0, 0.0]))
    points = [
        TrajectoryPoint(t, pin.SE3(np.eye(3), np.array([x, 0.0, 0.0])))
        for t, x in ((0.0, 0.4), (1.0, 0.6))
    ]
    motion, hand = TrajectoryMotion(PoseTrajectory(points), 0, DT), Hand()
    for k in range(1000):
        assert motion.advance(hand, State(np.zeros(1), np.zeros(1)), 10**9 + round(k * 1e9 * DT))
    np.testing.assert_allclose(hand.goal[0].translation, far.translation, atol=1e-6)
    assert motion.pace.waits
    assert not motion.pace.lost
    hand.robot.pose = far
    motion.advance(hand, State(np.zeros(1), np.zeros(1)), 10**9 + round(1000e9 * DT))
    assert not motion.pace.waits
