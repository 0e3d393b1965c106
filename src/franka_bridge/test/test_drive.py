# SPDX-License-Identifier: Apache-2.0
"""The law of the drives keeps all limits, whatever commands do."""

import numpy as np
import pinocchio as pin
import pytest

from franka_bridge.drive import Drive
from viability_bounds_pkg.joint_limits import JointLimits
from viability_bounds_pkg.robot.description import build_model, frame_id
from viability_bounds_pkg.robot.files import read_urdf
from viability_bounds_pkg.viability import BoundsSolver

# Its kinematics, limits of torque and inertias are near to those of FR3.
JOINTS = [f"panda_joint{j}" for j in range(1, 8)]
URDF = read_urdf("package://example-robot-data/robots/panda_description/urdf/panda.urdf")
LIMITS = JointLimits(
    JOINTS,
    [-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973],
    [2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973],
    [1.3, 1.3, 1.3, 1.3, 2.5, 2.0, 2.5],
    -np.array([10.0, 3.0, 10.0, 10.0, 10.0, 10.0, 10.0]),
    [10.0, 3.0, 10.0, 10.0, 10.0, 10.0, 10.0],
    [0.652, 0.25, 0.2005, 0.3542, 0.5738, 0.4885, 0.4592],
    [6.0, 2.585, 3.5, 4.0, 17.0, 5.5, 17.0],
)
TAU_MAX = np.array([87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0])
H = 1e-3  # s
RATE = 1000.0  # N m/s
JERK = np.array([300.0, 200.0, 300.0, 300.0, 800.0, 800.0, 1000.0])  # rad/s^3
HELD = 5  # periods
ROUNDING = 1e-9
FLANGE = "panda_link8"


class Arm:
    """An arm that adds gravity to what it is sent, with the load that it was told."""

    def __init__(self, q, v=None, included=False, load=0.0):
        model = build_model(URDF, JOINTS)
        self.drive = Drive(model.copy(), LIMITS, TAU_MAX, np.full(7, RATE), H, included, True)
        self.model, self.data = model, model.createData()
        self.known = model.copy()
        self.sent = np.zeros(7)
        self.q, self.v = np.array(q), np.zeros(7) if v is None else np.array(v)
        if load:
            hand = model.frames[frame_id(model, "panda_hand")]
            carried = pin.Inertia(load, np.array([0.0, 0.02, 0.1]), np.zeros((3, 3)))
            model.inertias[7] += hand.placement.act(carried)
            self.drive.payload.carry("panda_hand", load, carried.lever, carried.inertia)
        self.worst = {"position": -np.inf, "speed": -np.inf, "torque": 0.0, "rate": 0.0}

    def begin(self):
        self.drive.start(self.q, self.v, self.sent)

    def gravity(self, model=None):
        model = model or self.model
        return pin.computeGeneralizedGravity(model, model.createData(), self.q).copy()

    def step(self, command, held=False):
        sent = self.drive.torque(self.q, self.v, command, held, self.sent).copy()
        tau = sent + self.gravity(self.known)
        change = np.abs(sent - self.sent).max() / H
        a = pin.aba(self.model, self.data, self.q + 0.5 * H * self.v, self.v, tau)
        self.q = self.q + H * self.v + 0.5 * H * H * a
        self.v, self.sent = self.v + H * a, sent
        beyond = np.maximum(self.q - LIMITS.q_max, LIMITS.q_min - self.q).max()
        lowest, highest = LIMITS.velocities(self.q)
        for key, value in (
            ("position", beyond),
            ("speed", np.maximum(self.v - highest, lowest - self.v).max()),
            ("torque", (np.abs(sent) / TAU_MAX).max()),
            ("rate", change),
        ):
            self.worst[key] = max(self.worst[key], value)
        return tau

    def kept_all_limits(self):
        assert self.worst["position"] <= 0.0
        assert self.worst["speed"] <= 0.0
        assert self.worst["torque"] <= 1.0
        assert self.worst["rate"] <= RATE * (1.0 + ROUNDING)

    def command_for(self, a):
        """The command for an acceleration, without gravity."""
        middle = self.q + 0.5 * H * self.v, self.v + 0.5 * H * a
        return pin.rnea(self.model, self.data, *middle, a) - self.gravity()


class Controller:
    """Drives joints to their limits and along them, by changes that motors can follow."""

    def __init__(self, rng):
        room = LIMITS.q_max - LIMITS.q_min
        self.start = LIMITS.q_min + rng.uniform(0.2, 0.8, 7) * room
        self._goal = np.where(rng.random(7) < 0.5, LIMITS.q_min - 0.3, LIMITS.q_max + 0.3)
        # As in config/fr3.yaml: a horizon of 20 ms.
        self._solver = BoundsSolver(LIMITS, 20 * H, np.full(7, 0.3), period=H)
        self._last = np.zeros(7)

    def acceleration(self, q, v):
        wanted = 30.0 * (self._goal - q) - 11.0 * v
        gentle = np.clip(wanted, self._last - JERK * H, self._last + JERK * H)
        bounds = self._solver.bounds(q, v)
        self._last = np.clip(gentle, bounds.lower, bounds.upper)
        return self._last


# In the last one commands ask for more than the limits of torque rates: clipped joint by joint,
# they would throw other joints.
@pytest.mark.parametrize("seed", [0, 1, 2, 3, 108])
def test_commands_cut_at_random_end_in_a_stop_within_all_limits(seed):
    rng = np.random.default_rng(seed)
    controller = Controller(rng)
    arm = Arm(controller.start)
    arm.begin()
    for _ in range(rng.integers(300, 1500)):
        arm.step(command := arm.command_for(controller.acceleration(arm.q, arm.v)))
    assert np.abs(arm.v).max() > 0.2
    for _ in range(HELD):
        arm.step(command, held=True)
    for _ in range(800):
        arm.step(None)
    assert arm.drive.stop.at_rest
    assert np.abs(arm.v).max() < 1e-3  # rad/s
    arm.kept_all_limits()


def test_commands_that_come_and_go_keep_all_limits():
    rng = np.random.default_rng(7)
    controller = Controller(rng)
    arm = Arm(controller.start)
    arm.begin()
    missing = 0
    for _ in range(2500):
        missing = max(0, missing - 1) or (int(rng.integers(1, 40)) if rng.random() < 0.02 else 0)
        if not missing:
            command = arm.command_for(controller.acceleration(arm.q, arm.v))
        arm.step(command if missing <= HELD else None, held=missing > 0)
    arm.kept_all_limits()


@pytest.mark.parametrize("included", [True, False])
def test_a_standing_arm_is_taken_over_without_a_jerk(included):
    arm = Arm([0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785], included=included)
    arm.begin()
    start = arm.q.copy()
    for _ in range(100):
        arm.step(None)
    for _ in range(400):
        arm.step(arm.gravity() if included else np.zeros(7))
    np.testing.assert_allclose(arm.q, start, atol=1e-6)  # rad
    assert np.abs(arm.sent).max() < 1e-3  # N m


@pytest.mark.parametrize("told", [True, False])
def test_a_load_counts_once_whether_the_robot_knows_it_or_not(told):
    arm = Arm([0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785], load=2.0)
    hand = arm.model.frames[frame_id(arm.model, "panda_hand")].placement
    flange = arm.model.frames[frame_id(arm.model, FLANGE)].placement
    if told:
        load = arm.drive.tell_load(FLANGE)
        assert load.mass == 2.0
        np.testing.assert_allclose(
            load.lever, flange.actInv(hand).act(np.array([0.0, 0.02, 0.1])), atol=1e-12
        )
        arm.known = arm.model
    arm.begin()
    for _ in range(100):  # the torques for it come by at most 1 N m a period
        tau = arm.step(None)
    for _ in range(300):
        tau = arm.step(np.zeros(7))
    np.testing.assert_allclose(tau, arm.gravity(), atol=0.05)  # N m
    assert (np.abs(arm.sent).max() > 5.0) == (not told)


def test_a_load_elsewhere_than_on_the_flange_is_not_told():
    arm = Arm(np.zeros(7))
    arm.drive.payload.carry("panda_link4", 1.0, np.zeros(3), np.zeros((3, 3)))
    assert arm.drive.tell_load(FLANGE).mass == 0.0
    assert str(arm.drive.told) == "none"


def test_steps_of_torque_count_from_what_the_robot_has():
    """A packet that was lost is not made up for by a step that is twice as large."""
    arm = Arm([0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785])
    arm.begin()
    for _ in range(200):
        arm.step(np.zeros(7))
    wanted, has = np.full(7, 10.0), np.zeros(7)
    for _ in range(3):
        sent = arm.drive.torque(arm.q, arm.v, wanted, False, has)
        assert 0.5 < np.abs(sent - has).max() <= RATE * H
    sent = arm.drive.torque(arm.q, arm.v, wanted, False, sent)
    assert np.abs(sent).max() > RATE * H


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e300])
def test_torques_are_finite_and_within_limits_for_any_numbers(bad):
    arm = Arm(np.zeros(7))
    arm.begin()
    for q, v, command in (
        (np.zeros(7), np.full(7, bad), None),
        (np.full(7, bad), np.zeros(7), np.zeros(7)),
        (np.zeros(7), np.zeros(7), np.full(7, bad)),
    ):
        before = arm.sent
        with np.errstate(all="ignore"):
            arm.sent = arm.drive.torque(q, v, command, False, arm.sent).copy()
        assert np.isfinite(arm.sent).all()
        assert (np.abs(arm.sent) <= TAU_MAX).all()
        assert np.abs(arm.sent - before).max() <= RATE * H * (1.0 + ROUNDING)


def test_the_arm_comes_to_rest_although_torques_come_late():
    rng = np.random.default_rng(0)
    arm = Arm([0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785], [0.2, 0.0, -0.3, 0.0, 0.0, 0.0, 0.0])
    arm.model.armature = np.array([0.2, 0.2, 0.2, 0.2, 0.0, 0.0, 0.0])  # unknown
    arm.begin()
    on_their_way = np.zeros(7)
    for _ in range(1000):
        a = pin.aba(arm.model, arm.data, arm.q, arm.v, arm.sent + arm.gravity(arm.known))
        if rng.random() < 0.85:  # else the state was lost
            arm.sent = on_their_way
            on_their_way = arm.drive.torque(arm.q, arm.v, None, False, arm.sent).copy()
        arm.q, arm.v = arm.q + H * arm.v, arm.v + H * a
    assert arm.drive.stop.at_rest
    np.testing.assert_allclose(arm.v, 0.0, atol=5e-3)  # rad/s


def test_torques_that_act_late_or_never_throw_no_joint():
    """What the arm does otherwise than asked is no disturbance, for the law to act against."""
    rng = np.random.default_rng(3)
    controller = Controller(rng)
    arm = Arm(controller.start)
    arm.begin()
    on_its_way, lost, beyond, fastest = arm.sent, 0, 0.0, 0.0
    for _ in range(2000):
        acting = arm.sent  # in this period still
        if rng.random() < 0.1:
            lost += 1
        else:
            arm.sent = on_its_way
            command = arm.command_for(controller.acceleration(arm.q, arm.v))
            on_its_way = arm.drive.torque(arm.q, arm.v, command, False, acting, lost == 0).copy()
            lost = 0
        a = pin.aba(arm.model, arm.data, arm.q, arm.v, acting + arm.gravity())
        arm.q, arm.v = arm.q + H * arm.v, arm.v + H * a
        lowest, highest = LIMITS.velocities(arm.q)
        beyond = max(beyond, np.maximum(arm.v - highest, lowest - arm.v).max())
        fastest = max(fastest, np.abs(arm.v).max())
    assert fastest > 1.0
    assert beyond < 0.05  # rad/s: the limits are for torques that act at once
