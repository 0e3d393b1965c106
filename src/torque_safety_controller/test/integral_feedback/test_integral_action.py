# SPDX-License-Identifier: Apache-2.0
"""The integral action of an arm: no jolt from settings, jumps of time or state, or bad numbers."""

import math
from copy import deepcopy
from functools import cache

import numpy as np
import pytest
from arms import load_arm

from torque_safety_controller.integral_feedback import MODES, IntegralSettings
from torque_safety_controller.parts.integral import make_integral
from torque_safety_controller.robot_model import RobotModel
from viability_bounds_pkg.state import State

ARM = load_arm("panda")
N = ARM.n
DT = 1e-3
LAMBDA = 30.0
BUDGET = 0.2 * ARM.tau_max
REST = np.zeros(N)
# N m; what acts on the joints and the model does not know.
DISTURBANCE = 0.06 * ARM.tau_max * np.array([1.0, -1.0, 1.0, 1.0, -1.0, 1.0, -1.0])


def make_settings(**changed) -> IntegralSettings:
    return IntegralSettings(**{"budget": BUDGET, "gain": LAMBDA} | changed)


class IntegralLoop:
    """An arm that holds its posture by a spring and a damper, and the integral action."""

    def __init__(self, mode, disturbance_max=2.0, **changed) -> None:
        self.robot = ARM.robot(DT)
        self.action = make_integral(mode, make_settings(**changed), disturbance_max * ARM.tau_max)
        self.q, self.v, self.a = ARM.q_start.copy(), REST, REST
        self.torques = [REST]

    def step(self, elapsed=DT, v_seen=None) -> np.ndarray:
        """Play a period; return what was added."""
        v = self.v if v_seen is None else v_seen
        self.robot.update(State(self.q, v), self.a)
        added = self.action.torque(self.robot, self.a, elapsed)
        self.a = 100.0 * (ARM.q_start - self.q) - 20.0 * v
        tau = self.robot.torque(self.a) + added + DISTURBANCE
        self.q, self.v = ARM.move(self.q, self.v, tau, DT, steps=1)
        self.torques.append(added)
        return added

    def run(self, seconds):
        for _ in range(round(seconds / DT)):
            self.step()
        return self

    def steps(self, last) -> float:
        """Return the largest change of torque in the last steps, in torque limits."""
        return relative(np.diff(np.array(self.torques[-last - 1 :]), axis=0))


def relative(torque) -> float:
    return float(np.abs(torque / ARM.tau_max).max())


@cache
def settled_once(mode, **changed) -> IntegralLoop:
    loop = IntegralLoop(mode, **changed).run(0.4)
    assert relative(loop.action.last) > 0.03 or mode == "none"
    assert loop.steps(50) < 2e-4
    return loop


def settled(mode, **changed) -> IntegralLoop:
    """An arm whose integral action carries a good part of the disturbance, to be moved on."""
    return deepcopy(settled_once(mode, **changed))


# Settings and beginnings


@pytest.mark.parametrize(("mode", "largest_step"), [("joints", 2e-3), ("task", 5e-3)])
def test_settings_change_without_a_jump(mode, largest_step):
    for changed in (
        {"budget": 0.01 * ARM.tau_max},
        {"gain": 2.0},
        {"gain": 80.0},
        {"slow_leak_rate": 1.0},
        {"fast_leak_rate": 5.0},
        {"mu": 0.9},
    ):
        loop = settled(mode)
        loop.action.settings = make_settings(**changed)
        loop.run(0.05)
        assert loop.steps(50) < largest_step, changed


def test_a_budget_that_shrinks_is_kept_soon():
    loop = settled("joints")
    small, begin = 0.01 * ARM.tau_max, relative(loop.action.last)
    loop.action.settings = make_settings(budget=small)
    for _ in range(1200):
        loop.step()
        assert relative(loop.action.last) < 1.05 * begin
    assert (np.abs(loop.action.last) <= 1.02 * small).all()
    assert loop.action.saturated.any()


@pytest.mark.parametrize("mode", MODES)
def test_it_begins_with_the_torque_it_is_told(mode):
    rng = np.random.default_rng(5)
    for _ in range(5):
        loop = IntegralLoop(mode)
        torque = rng.uniform(-0.3, 0.3, N) * ARM.tau_max
        loop.robot.update(State(loop.q, REST), REST)
        loop.action.resume(loop.robot, torque)
        np.testing.assert_array_equal(loop.action.last, torque)
        after = loop.action.torque(loop.robot, REST, DT)
        assert relative(after - torque) <= 0.01


@pytest.mark.parametrize("mode", ["none", "joints"])
def test_what_no_memory_can_hold_fades(mode, monkeypatch):
    loop = IntegralLoop(mode)
    loop.robot.update(State(loop.q, REST), REST)
    C = -LAMBDA * np.diag(np.diagonal(loop.robot.M))  # C + K is singular
    monkeypatch.setattr(RobotModel, "C", C)
    torque = 0.1 * ARM.tau_max
    loop.action.resume(loop.robot, torque)
    np.testing.assert_array_equal(loop.action.last, torque)
    after = loop.action.torque(loop.robot, REST, DT)
    np.testing.assert_allclose(after, torque * math.exp(-DT / 0.2), rtol=1e-9)


@pytest.mark.parametrize("mode", MODES[1:])
def test_what_is_forgotten_again_and_again_fades_from_what_it_was(mode):
    """As while the motors do not do as they are told: no time counts then."""
    loop = settled(mode)
    torques = [loop.action.last.copy()]
    for _ in range(300):
        loop.action.forget()
        loop.robot.update(State(loop.robot.q, loop.robot.v), REST)
        torques.append(loop.action.torque(loop.robot, REST, math.inf))
    assert relative(np.diff(torques, axis=0)) < 0.02 * relative(torques[0])
    np.testing.assert_allclose(torques[-1], torques[0] * math.exp(-300 * DT / 0.2), rtol=0.05)


# Time that jumps


@pytest.mark.parametrize("mode", ["none", "joints", "task"])
@pytest.mark.parametrize(
    ("gap", "skipped"),
    [(0.5, 0), (2.0, 0), (2.6, 1), (3.6e6, 1), (0, 1), (-1e3, 1), (math.nan, 1), (math.inf, 1)],
)
def test_time_may_jump(mode, gap, skipped):
    """By a gap of so many periods; half and twice a period are integrated over."""
    loop = settled(mode)
    loop.step(elapsed=gap * DT)
    skipped = skipped if mode != "none" else 0  # what only fades integrates nothing
    assert loop.action.skipped == skipped
    loop.run(0.05)
    # At most 1.25% of what is to fade, which is no more than the budget.
    assert loop.steps(51) < (0.0125 * 0.2 if skipped else 1e-3)
    assert loop.action.skipped == skipped


def test_the_memory_fades_while_time_jumps_again_and_again():
    """As when the robot sends a hundredth of the states that it should."""
    loop = settled("joints")
    begin = loop.action.last
    for _ in range(300):
        loop.step(elapsed=100.0 * DT)
        assert loop.steps(1) < 0.0125 * 0.2
    assert loop.action.skipped == 300
    # 30 s at the slow rate of 0.1 1/s.
    assert relative(loop.action.last) < 0.2 * relative(begin)


# Velocities and positions that jump


@pytest.mark.parametrize(
    ("mode", "size"), [("joints", 10.0), ("joints", -1e308), ("task", -300.0), ("task", 1e100)]
)
def test_a_glitch_of_the_velocity_is_not_integrated(mode, size):
    loop, other = settled(mode), settled(mode)
    seen, before = loop.v.copy(), loop.action.last
    seen[2] += size
    with np.errstate(all="ignore"):
        np.testing.assert_array_equal(loop.step(v_seen=seen), before)
    other.step()
    # What the spring and the damper make of a glitch is not of interest here.
    loop.q, loop.v, loop.a = other.q.copy(), other.v.copy(), other.a.copy()
    loop.run(0.05)
    other.run(0.05)
    assert loop.action.skipped in (2, 3)
    assert loop.steps(51) < 1e-3
    assert relative(loop.action.last - other.action.last) < 2e-3


def test_a_position_that_jumps_is_seen_and_one_that_moves_is_not():
    loop = settled("joints")
    loop.q = loop.q + 0.04  # as rough as an encoder may be
    loop.step()
    assert loop.action.skipped == 0
    loop.q = loop.q + 0.06
    loop.step()
    assert loop.action.skipped == 1
    loop.v = np.full(N, 2.0)  # rad/s
    loop.step()
    assert loop.action.skipped == 2, "so sudden"
    begin = loop.q
    for _ in range(100):
        loop.v = np.full(N, 2.0)
        loop.step()
    assert np.abs(loop.q - begin).max() > 0.15
    assert loop.action.skipped == 2


@pytest.mark.parametrize("mode", ["joints", "position"])
def test_a_state_far_away_kicks_no_joint(mode):
    """The arm is put elsewhere, as by a reset: other inertias, and far from its reference."""
    rng = np.random.default_rng(3)
    for _ in range(3):
        loop = settled(mode)
        loop.q, _ = ARM.random_state(rng)
        loop.v, before = REST, loop.action.last
        np.testing.assert_array_equal(loop.step(), before)
        assert loop.action.skipped == 1
        loop.run(0.2)
        # Then it grows, no faster than the accelerations that are asked for.
        assert loop.steps(200) < 2.0 * LAMBDA * DT
        assert (np.abs(loop.action.last) <= 1.3 * BUDGET).all()


def test_steps_are_bounded_whatever_velocity_does():
    """Of (C + K) s the increment of s changes K s by at most 2 lambda dt tau_max."""
    rng = np.random.default_rng(4)
    loop = IntegralLoop("joints", budget=np.full(N, np.inf), slow_leak_rate=0, fast_leak_rate=0)
    bound = 2.0 * LAMBDA * DT
    largest, before = 0.0, np.zeros(N)
    for _ in range(600):
        v = rng.uniform(-1.0, 1.0, N) * ARM.v_max * rng.choice([1e-3, 0.01, 0.1, 1.0])
        loop.robot.update(State(ARM.q_start, v), REST)
        loop.action.torque(loop.robot, rng.uniform(-20.0, 20.0, N), DT)
        K_s = loop.action.law.s * LAMBDA * np.diagonal(loop.robot.M)
        largest, before = max(largest, relative(K_s - before)), K_s
    # The mass matrix is that of the middle of the step, which differs by what v dt / 2 does.
    assert 0.5 * bound < largest < 1.1 * bound
    assert 0 < loop.action.skipped < 600


# Numbers beyond sense


@pytest.mark.parametrize("mode", ["none", "joints", "task"])
def test_numbers_beyond_sense_keep_the_last_torque(mode):
    for bad in (math.nan, -math.inf):
        loop = settled(mode)
        before, seen = loop.action.last, loop.v.copy()
        seen[0] = bad
        with np.errstate(all="ignore"):
            loop.robot.update(State(loop.q, seen), loop.a)
        np.testing.assert_array_equal(loop.action.torque(loop.robot, loop.a, DT), before)
        loop.run(0.02)
        assert loop.steps(20) < 1e-3
        # Since when the velocity has changed is not known in the next step either.
        assert loop.action.skipped == (0 if mode == "none" else 2)


@pytest.mark.parametrize("mode", ["joints", "task"])
def test_a_beginning_with_numbers_beyond_sense_is_put_off(mode):
    loop = IntegralLoop(mode)
    with np.errstate(all="ignore"):
        loop.robot.update(State(loop.q, np.full(N, math.nan)), loop.a)
    np.testing.assert_array_equal(loop.action.torque(loop.robot, loop.a, DT), REST)
    loop.action.settings = make_settings(gain=20.0)
    np.testing.assert_array_equal(loop.action.torque(loop.robot, loop.a, DT), REST)
    loop.run(0.4)
    assert relative(loop.action.last) > 0.02
