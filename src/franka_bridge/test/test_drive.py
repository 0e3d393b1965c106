# SPDX-License-Identifier: Apache-2.0
"""The law of the drives keeps all limits, whatever commands do."""

import numpy as np
import pinocchio as pin
import pytest

from franka_bridge.drive import Drive
from viability_bounds_pkg.joint_limits import JointLimits
from viability_bounds_pkg.robot.description import build_model, frame_id
from viability_bounds_pkg.robot.files import read_urdf

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
)
TAU_MAX = np.array([87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0])
H = 1e-3  # s
RATE = 1000.0  # N m/s
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
        for key, value in (
            ("position", beyond),
            ("speed", (np.abs(self.v) - LIMITS.v_max).max()),
            ("torque", (np.abs(sent) / TAU_MAX).max()),
            ("rate", change),
        ):
            self.worst[key] = max(self.worst[key], value)
        return tau

    def command_for(self, a):
        """The command for an acceleration, without gravity."""
        middle = self.q + 0.5 * H * self.v, self.v + 0.5 * H * a
        return pin.rnea(self.model, self.data, *middle, a) - self.gravity()


class Motion:
    """A motion from one random place to another, to the limits of joints, within all limits."""

    def __init__(self, rng):
        room = LIMITS.q_max - LIMITS.q_min
        self.start = LIMITS.q_min + rng.uniform(0.1, 0.9, 7) * room
        end = np.where(rng.random(7) < 0.5, 0.001, 0.999)
        self.way = LIMITS.q_min + end * room - self.start
        share = np.abs(self.way) / LIMITS.v_max, np.abs(self.way) / LIMITS.a_max
        # Speeds of s = 10 x^3 - 15 x^4 + 6 x^5 are up to 1.875, accelerations up to 5.774.
        self.duration = max(1.9 * share[0].max(), np.sqrt(6.5 * share[1].max()))

    def acceleration(self, t, q, v):
        x = min(t / self.duration, 1.0)
        s = x**3 * (10.0 - 15.0 * x + 6.0 * x * x)
        ds = 30.0 * x * x * (1.0 - x) ** 2 / self.duration
        dds = 60.0 * x * (1.0 - x) * (1.0 - 2.0 * x) / self.duration**2
        error, slower = self.start + s * self.way - q, ds * self.way - v
        return dds * self.way + 900.0 * error + 60.0 * slower


@pytest.mark.parametrize("seed", [1, 2, 4])
def test_commands_cut_at_random_end_in_a_stop_within_all_limits(seed):
    rng = np.random.default_rng(seed)
    motion = Motion(rng)
    arm = Arm(motion.start)
    arm.begin()
    cut = int(rng.uniform(0.2, 0.9) * motion.duration / H)
    for k in range(cut):
        arm.step(command := arm.command_for(motion.acceleration(k * H, arm.q, arm.v)))
    assert np.abs(arm.v).max() > 0.2
    for _ in range(HELD):
        arm.step(command, held=True)
    for _ in range(800):
        arm.step(None)
    assert arm.drive.stop.at_rest
    assert np.abs(arm.v).max() < 1e-3  # rad/s
    assert arm.worst["position"] <= 0.0
    assert arm.worst["speed"] <= 0.0
    assert arm.worst["torque"] <= 1.0
    assert arm.worst["rate"] <= RATE * (1.0 + ROUNDING)


def test_commands_that_come_and_go_keep_all_limits():
    rng = np.random.default_rng(7)
    motion = Motion(rng)
    arm = Arm(motion.start)
    arm.begin()
    missing, at = 0, 0.0
    for _ in range(2500):
        missing = max(0, missing - 1) or (int(rng.integers(1, 40)) if rng.random() < 0.02 else 0)
        if not missing:
            at += H
            command = arm.command_for(motion.acceleration(at, arm.q, arm.v))
        arm.step(command if missing <= HELD else None, held=missing > 0)
    assert arm.worst["position"] <= 0.0
    assert arm.worst["speed"] <= 0.0
    assert arm.worst["rate"] <= RATE * (1.0 + ROUNDING)


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
    arm.drive.stop._passed_for = 1.0  # commands act by themselves
    for _ in range(200):
        arm.step(np.zeros(7))
    wanted, has = np.full(7, 10.0), np.zeros(7)
    first = arm.drive.torque(arm.q, arm.v, wanted, False, has).copy()
    second = arm.drive.torque(arm.q, arm.v, wanted, False, has).copy()
    np.testing.assert_allclose(first, 1.0, atol=1e-3)
    np.testing.assert_allclose(second, 1.0, atol=1e-3)
    np.testing.assert_allclose(
        arm.drive.torque(arm.q, arm.v, wanted, False, second), 2.0, atol=1e-3
    )


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
