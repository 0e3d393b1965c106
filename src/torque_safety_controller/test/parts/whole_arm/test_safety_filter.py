# SPDX-License-Identifier: Apache-2.0
"""The filter on Baxter, whose shoulder cannot hold the stretched arm, against an adversary."""

import numpy as np
import pinocchio as pin
import pytest

from torque_safety_controller.parts.whole_arm.safety_filter import SafetyFilter
from viability_bounds_pkg.cli.limits_file import read_robot
from viability_bounds_pkg.joint_limits import JointLimits
from viability_bounds_pkg.testing.ros_harness import config_folder, read_config
from viability_bounds_pkg.viability import BoundsSolver

ROUNDING = 1e-9
SHOULDER, ELBOW = 1, 3
RESERVE = 0.03
"""Share of the torque limits that plans leave."""


class Arm:
    """A robot of a parameter file under exact accelerations, each kept for a control period."""

    def __init__(self, robot, share=1.0):
        self.name = robot
        values = read_config(robot, "controller_node")
        self.model = read_robot(config_folder() / f"{robot}.yaml").model
        self.data = self.model.createData()
        keys = ("position_min", "position_max", "velocity_max")
        keys = (*keys, "acceleration_min", "acceleration_max")
        bounds = read_config(robot, "bounds_node")
        self.limits = JointLimits(bounds["joints"], *(np.array(bounds[key]) for key in keys))
        self.tau_max = share * np.array(values["torque_max"])
        self.dt = 1.0 / values["rate_hz"]
        self.n = len(self.limits)
        braking = np.minimum(-self.limits.a_min, self.limits.a_max)
        self.solver = BoundsSolver(self.limits, 2.0 * self.dt, 0.05 * braking, period=self.dt)
        self.start = np.array(read_config(robot, "bullet_node")["start_positions"])

    def filter(self, **reserve):
        limits = self.limits
        return SafetyFilter(
            self.model,
            limits.q_min,
            limits.q_max,
            limits.a_min,
            limits.a_max,
            self.tau_max,
            self.dt,
            **reserve,
        )

    def torque(self, q, v, a):
        return pin.rnea(self.model, self.data, q, v, a).copy()

    def mid_torque(self, q, v, a):
        """What is held during a step for mean acceleration `a`."""
        h = 0.5 * self.dt
        return self.torque(q + (v + 0.5 * a * h) * h, v + a * h, a)

    def possible(self, q, v, plan, a):
        """What the torque limits allow of the way from `plan` to `a`, as the QP would."""
        least, most = -self.tau_max, self.tau_max
        share, low = 1.0, self.mid_torque(q, v, plan)
        for _ in range(4):  # the torque in the middle of the step is only nearly linear
            high = self.mid_torque(q, v, plan + share * (a - plan))
            room = np.where(high > low, most - low, least - low)
            with np.errstate(divide="ignore", invalid="ignore"):
                more = np.where(high == low, 1.0, room / (high - low)).min()
            share *= float(np.clip(more, 0.0, 1.0))
        return plan + share * (a - plan)

    def play(self, wanted, seconds, filtered=True):
        """Drive the arm; return the worst of positions, speeds and torques, and the states."""
        limits, dt = self.limits, self.dt
        keeper = self.filter()
        q, v = self.start.copy(), np.zeros(self.n)
        zero = np.zeros(self.n)
        worst, states = np.zeros(3), []
        for k in range(round(seconds / dt)):
            lower, upper, _ = self.solver.bounds(q, v)
            keeper.update(q, v, zero, lower, upper)
            a = np.clip(wanted(k * dt, q, v), keeper.lower, keeper.upper)
            a = self.possible(q, v, keeper.plan, a)
            if filtered:
                a = keeper.passed(a)
            worst[2] = max(worst[2], (np.abs(self.mid_torque(q, v, a)) / self.tau_max).max())
            q, v = q + (v + 0.5 * a * dt) * dt, v + a * dt
            beyond = np.maximum(q - limits.q_max, limits.q_min - q).max()
            worst[:2] = np.maximum(worst[:2], [beyond, (np.abs(v) - limits.v_max).max()])
            states.append((q, v))
        return worst, states, keeper


def bang_bang(arm, seed, duration=0.4):
    """Every joint to and fro as hard as its bounds allow, for random times."""
    rng = np.random.default_rng(seed)
    ends = {}

    def wanted(t, q, v):
        return ends.setdefault(int(t / duration), rng.choice([-1e3, 1e3], arm.n))

    return wanted


def heavier(arm):
    """Each joint to where gravity asks for most of its motor: the worst of all goals."""
    step = 1e-4

    def wanted(t, q, v):
        gravity = np.abs(pin.computeGeneralizedGravity(arm.model, arm.data, q))
        slope = np.zeros(arm.n)
        for j in range(arm.n):
            moved = q.copy()
            moved[j] += step
            there = np.abs(pin.computeGeneralizedGravity(arm.model, arm.data, moved))
            slope[j] = ((there - gravity) / arm.tau_max).sum()
        return 1e3 * np.sign(slope)

    return wanted


ARMS = [("baxter_left_arm", 1.0), ("panda", 0.6), ("talos_left_arm", 0.6)]


@pytest.fixture(scope="module", params=ARMS, ids=lambda each: f"{each[0]}-{each[1]}")
def arm(request):
    return Arm(*request.param)


def test_no_limit_is_passed_whatever_is_wanted_and_then_the_arm_comes_to_rest(arm):
    """In the end nothing is wanted: the plans alone, from wherever the adversary had got to."""
    adversary, stop = bang_bang(arm, 0), 2.0

    def wanted(t, q, v):
        return adversary(t, q, v) if t < stop else -v / arm.dt

    worst, states, keeper = arm.play(wanted, stop + 1.5)
    assert (worst <= [ROUNDING, ROUNDING, 1.0 + ROUNDING]).all()
    assert keeper.outcomes["outside"] == 0
    assert keeper.outcomes["as wanted"] > 0
    q, v = states[-1]
    assert np.abs(v).max() < 1e-6
    held = np.abs(arm.torque(q, np.zeros(arm.n), np.zeros(arm.n)))
    assert (held <= arm.tau_max).all()


def test_no_limit_is_passed_where_the_worst_posture_is_wanted():
    arm = Arm("baxter_left_arm")
    worst, states, _ = arm.play(heavier(arm), 2.5)
    assert (worst <= [ROUNDING, ROUNDING, 1.0 + ROUNDING]).all()
    # Pressed against what its shoulder can hold.
    q, zero = states[-1][0], np.zeros(arm.n)
    load = arm.torque(q, zero, zero)[SHOULDER] / arm.tau_max[SHOULDER]
    assert 0.94 <= abs(load) <= 1.0 - RESERVE + ROUNDING


def test_without_the_filter_baxter_passes_its_limits():
    arm = Arm("baxter_left_arm")
    worst = max(arm.play(bang_bang(arm, seed), 3.0, False)[0][2] for seed in range(3))
    assert worst > 1.0


def test_constraints_leave_the_plan_as_it_is():
    """They allow its acceleration, so that a QP with them, bounds and torques has a solution."""
    arm = Arm("baxter_left_arm")
    _, states, _ = arm.play(bang_bang(arm, 1), 1.5)
    keeper, zero, seen = arm.filter(), np.zeros(arm.n), 0
    for q, v in states[::5]:
        lower, upper, _ = arm.solver.bounds(q, v)
        keeper.forget_plan()
        rows = keeper.update(q, v, zero, lower, upper)
        if rows is None or keeper.slack < 0.01:
            continue
        seen += 1
        assert (rows.G @ keeper.plan <= rows.upper + ROUNDING).all()
    assert seen > 0


def test_plans_leave_a_reserve_and_count_what_is_more_than_it():
    """Whatever acts besides, up to the reserve, may change at any time: plans do not see it."""
    arm = Arm("baxter_left_arm")
    reserve = 0.1 * arm.tau_max
    keeper = arm.filter(torque_reserve=reserve)
    bent, zero, wide = arm.start.copy(), np.zeros(arm.n), np.full(arm.n, 1e3)
    bent[ELBOW] = 2.3
    np.testing.assert_allclose(keeper.usable, (1.0 - RESERVE) * arm.tau_max - reserve)
    keeper.update(bent, zero, zero, -wide, wide)
    held = keeper.rest_torque
    for share, counted in ((-1.0, 0.0), (0.7, 0.0), (1.0, 0.0), (1.5, 0.5), (-3.0, -2.0)):
        keeper.update(bent, zero, share * reserve, -wide, wide)
        np.testing.assert_allclose(keeper.rest_torque, held + counted * reserve, atol=ROUNDING)


def test_a_posture_that_cannot_be_held_is_told():
    arm = Arm("baxter_left_arm")
    stretched = np.array([0.0, -0.2, 0.0, 0.0, 0.0, 0.0, 0.0])
    keeper, zero, wide = arm.filter(), np.zeros(arm.n), np.full(arm.n, 1e3)
    keeper.update(stretched, zero, zero, -wide, wide)
    assert keeper.slack < 0.0
    assert abs(keeper.rest_torque[SHOULDER]) > arm.tau_max[SHOULDER]


def test_what_is_not_finite_never_passes():
    arm = Arm("baxter_left_arm")
    keeper, zero, wide = arm.filter(), np.zeros(arm.n), np.full(arm.n, 1e3)
    keeper.update(arm.start, zero, zero, -wide, wide)
    a = keeper.passed(np.full(arm.n, np.nan))
    np.testing.assert_array_equal(a, keeper.plan)
