# SPDX-License-Identifier: Apache-2.0
"""The additional torque of an arm whose motors give what they are told, less a disturbance."""

import math
from copy import deepcopy
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from arms import load_arm
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from torque_safety_controller.additional_torque import (
    MODES,
    AdditionalSettings,
    AdditionalTorque,
)
from torque_safety_controller.integral_feedback import METHODS, IntegralSettings
from viability_bounds_pkg.state import State

ARM = load_arm("panda")
N = ARM.n
DT = 1e-3
LAMBDA = 30.0
BUDGET = 0.2 * ARM.tau_max
REST = np.zeros(N)
# N m; what acts on the joints and the model does not know.
DISTURBANCE = 0.06 * ARM.tau_max * np.array([1.0, -1.0, 1.0, 1.0, -1.0, 1.0, -1.0])
POSITION = slice(0, 3)


def make_settings(mode="joints", disturbance=2.0, **changed) -> AdditionalSettings:
    integral = IntegralSettings(**{"budget": BUDGET, "gain": LAMBDA} | changed)
    return AdditionalSettings(mode, integral, disturbance * ARM.tau_max)


class IntegralLoop:
    """An arm that holds its posture by a spring and a damper, and the additional torque."""

    def __init__(self, mode="joints", rows=POSITION, **changed) -> None:
        self.robot = ARM.robot(DT)
        self.robot.rates = True
        self.additional = AdditionalTorque(make_settings(mode, **changed), rows)
        self.q, self.v, self.a = ARM.q_start.copy(), REST, REST
        self.torques = [REST]

    def step(self, elapsed=DT, v_seen=None, disturbance=DISTURBANCE) -> np.ndarray:
        """Play a period; return what was added."""
        v = self.v if v_seen is None else v_seen
        self.robot.update(State(self.q, v), self.a)
        added = self.additional.torque(self.robot, v, self.a, elapsed)
        self.a = 100.0 * (ARM.q_start - self.q) - 20.0 * v
        tau = self.robot.torque(self.a) + added + disturbance
        self.q, self.v = ARM.move(self.q, self.v, tau, DT, steps=1)
        self.torques.append(added)
        return added

    def run(self, seconds, **others):
        for _ in range(round(seconds / DT)):
            self.step(**others)
        return self

    def steps(self, last) -> float:
        """Return the largest change of torque in the last steps, in torque limits."""
        return relative(np.diff(np.array(self.torques[-last - 1 :]), axis=0))


def relative(torque) -> float:
    return float(np.abs(torque / ARM.tau_max).max())


def settled(mode, **changed) -> IntegralLoop:
    """An arm whose additional torque carries a good part of the disturbance, to be moved on."""
    return deepcopy(settled_once(mode, **changed))


@cache
def settled_once(mode, **changed) -> IntegralLoop:
    loop = IntegralLoop(mode, **changed).run(0.4)
    assert relative(loop.additional.last) > 0.03 or mode == "none"
    assert loop.steps(50) < 2e-4
    return loop


# No jumps


@pytest.mark.parametrize("before", MODES)
@pytest.mark.parametrize("after", MODES)
def test_modes_change_without_a_jump(before, after):
    loop = settled(before)
    loop.additional.settings = make_settings(after)
    loop.step()
    assert loop.steps(1) < 2e-4
    loop.run(0.2)
    # What a mode cannot take over fades with 0.2 s: 0.5% a period of less than the budget. A
    # stiffer mode has more error to integrate.
    assert loop.steps(200) < (1e-3 if after in ("none", before) else 5e-3)
    assert loop.additional.skipped == 0


def test_a_mode_that_is_left_fades_and_then_costs_nothing():
    loop = settled("joints")
    assert not loop.additional.idle
    loop.additional.settings = make_settings("none")
    torques = np.array(loop.run(1.0).torques[-1000:])
    assert (np.diff(np.abs(torques), axis=0) <= 1e-12).all()
    np.testing.assert_allclose(torques[-1], torques[0] * math.exp(-0.999 / 0.2), rtol=1e-6)
    loop.run(4.0)
    assert loop.additional.idle
    loop.additional.settings = make_settings("joints")
    assert not loop.additional.idle
    loop.run(0.4)
    assert relative(loop.additional.last) > 0.03


def test_changing_one_s_mind_within_a_step_is_no_change():
    loop, other = settled("joints"), settled("joints")
    for mode in ("task", "none", "joints"):
        loop.additional.settings = make_settings(mode)
    np.testing.assert_allclose(loop.step(), other.step(), atol=1e-9)


@pytest.mark.parametrize("mode", ["joints", "task"])
@pytest.mark.parametrize(
    "changed",
    [
        {"budget": 0.01 * ARM.tau_max},
        {"budget": np.zeros(N)},
        {"gain": 2.0},
        {"gain": 80.0},
        {"slow_leak_rate": 1.0},
        {"fast_leak_rate": 5.0},
        {"mu": 0.0},
        {"mu": 0.9},
    ],
    ids=lambda changed: " ".join(changed),
)
def test_settings_change_without_a_jump(mode, changed):
    loop = settled(mode)
    loop.additional.settings = make_settings(mode, **changed)
    loop.run(0.1)
    assert loop.steps(100) < (2e-3 if mode == "joints" else 5e-3)


@pytest.mark.parametrize("method", METHODS)
def test_ways_to_limit_change_without_a_jump(method):
    loop = IntegralLoop("joints", budget=0.03 * ARM.tau_max).run(0.4)
    assert loop.additional.saturated.any()
    loop.additional.settings = make_settings(budget=0.03 * ARM.tau_max, anti_windup=method)
    loop.run(0.1)
    assert loop.steps(100) < 2e-3


@pytest.mark.parametrize("mode", ["joints", "task"])
def test_a_budget_that_shrinks_is_kept_soon(mode):
    loop = settled(mode)
    small, begin = 0.01 * ARM.tau_max, relative(loop.additional.last)
    loop.additional.settings = make_settings(mode, budget=small)
    for _ in range(1000):
        loop.step()
        # Until then it is widened, and returns with 1 s; what cannot be in it fades with 0.2 s.
        assert relative(loop.additional.last) < 1.05 * begin
    loop.run(5.0)
    assert (np.abs(loop.additional.last) <= 1.02 * small).all()
    assert loop.additional.saturated.any()


# Time that jumps


GAPS = [10.0, 3600.0, 2.6 * DT, 0.0, -1.0, -1e9, 1e300, math.nan, math.inf, -math.inf]


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("gap", GAPS)
def test_time_may_jump(mode, gap):
    loop = settled(mode)
    loop.step(elapsed=gap)
    assert loop.additional.skipped == 1
    loop.run(0.05)
    # At most 1.25% of what is to fade, which is no more than the budget.
    assert loop.steps(51) < 0.0125 * 0.2
    assert loop.additional.skipped == 1


@pytest.mark.parametrize("gap", [0.5 * DT, 2.0 * DT])
def test_a_period_that_is_short_or_twice_as_long_is_integrated(gap):
    loop = settled("joints")
    loop.step(elapsed=gap)
    assert loop.additional.skipped == 0
    assert loop.steps(1) < 1e-3


def test_the_memory_fades_while_time_jumps_again_and_again():
    """As when the robot sends a third of the states that it should."""
    loop = settled("joints")
    begin = loop.additional.last
    for _ in range(2000):
        loop.step(elapsed=10.0 * DT)
        assert loop.steps(1) < 0.0125 * 0.2
    assert loop.additional.skipped == 2000
    # 20 s at the slow rate of 0.1 1/s.
    assert relative(loop.additional.last) < 0.2 * relative(begin)


def test_an_arm_that_stood_still_meanwhile_goes_on():
    loop = settled("joints")
    before = loop.additional.last
    loop.v = REST  # its brakes held it for 2 s
    loop.step(elapsed=2.0)
    loop.run(0.1)
    assert loop.steps(101) < 0.0125 * 0.2
    assert loop.additional.skipped == 1
    np.testing.assert_allclose(loop.additional.last, before, atol=0.02 * ARM.tau_max.max())


# Velocity that jumps, states that are far away


@pytest.mark.parametrize("mode", ["joints", "task"])
@pytest.mark.parametrize("size", [10.0, -300.0, 1e100, 1e308])
def test_a_glitch_of_the_velocity_is_not_integrated(mode, size):
    loop, other = settled(mode), settled(mode)
    seen = loop.v.copy()
    seen[2] += size
    before = loop.additional.last
    with np.errstate(all="ignore"):
        np.testing.assert_array_equal(loop.step(v_seen=seen), before)
    other.step()
    # What the spring and the damper make of a glitch is not of interest here.
    loop.q, loop.v, loop.a = other.q.copy(), other.v.copy(), other.a.copy()
    loop.run(0.05)
    other.run(0.05)
    assert loop.additional.skipped in (2, 3)
    assert loop.steps(51) < 1e-3
    assert relative(loop.additional.last - other.additional.last) < 2e-3


def test_without_that_it_would_be_felt_for_long():
    loop = settled("joints", disturbance=math.inf)
    other = settled("joints", disturbance=math.inf)
    seen = loop.v.copy()
    seen[2] += 10.0
    loop.step(v_seen=seen)
    other.step()
    assert loop.steps(1) > 0.1
    loop.q, loop.v, loop.a = other.q.copy(), other.v.copy(), other.a.copy()
    loop.run(0.05)
    other.run(0.05)
    assert relative(loop.additional.last - other.additional.last) > 0.04


def test_numbers_beyond_sense_keep_the_last_torque():
    for mode in MODES:
        for bad in (math.nan, math.inf, -math.inf):
            loop = settled(mode)
            before = loop.additional.last
            seen = loop.v.copy()
            seen[0] = bad
            with np.errstate(all="ignore"):
                loop.robot.update(State(loop.q, seen), loop.a)
            added = loop.additional.torque(loop.robot, seen, loop.a, DT)
            np.testing.assert_array_equal(added, before)
            loop.run(0.02)
            assert loop.steps(21) < 1e-3
            # Since when the velocity has changed is not known in the next step either.
            assert loop.additional.skipped == (0 if mode == "none" else 2)


@pytest.mark.parametrize("mode", MODES)
def test_a_beginning_with_numbers_beyond_sense_is_put_off(mode):
    loop = IntegralLoop(mode)
    seen = np.full(N, math.nan)
    with np.errstate(all="ignore"):
        loop.robot.update(State(loop.q, seen), loop.a)
    np.testing.assert_array_equal(loop.additional.torque(loop.robot, seen, loop.a, DT), REST)
    loop.additional.settings = make_settings("task")
    np.testing.assert_array_equal(loop.additional.torque(loop.robot, seen, loop.a, DT), REST)
    loop.run(0.4)
    assert relative(loop.additional.last) > 0.02


@pytest.mark.parametrize("mode", ["joints", "task"])
def test_a_state_far_away_kicks_no_joint(mode):
    """The arm is put elsewhere, as by a reset: other inertias, and far from its reference."""
    rng = np.random.default_rng(3)
    for _ in range(10):
        loop = settled(mode)
        loop.q, _ = ARM.random_state(rng)
        loop.v, before = REST, loop.additional.last
        np.testing.assert_array_equal(loop.step(), before)
        assert loop.additional.skipped == 1
        loop.run(0.3)
        # Then it grows, no faster than the accelerations that are asked for.
        assert loop.steps(300) < 2.0 * LAMBDA * DT
        assert (np.abs(loop.additional.last) <= 1.3 * BUDGET).all()


def test_a_position_that_jumps_is_seen_and_one_that_moves_is_not():
    loop = settled("joints")
    loop.q = loop.q + 0.04  # as rough as an encoder may be
    loop.step()
    assert loop.additional.skipped == 0
    loop.q = loop.q + 0.06
    loop.step()
    assert loop.additional.skipped == 1
    loop.v = np.full(N, 2.0)  # rad/s
    loop.step()
    assert loop.additional.skipped == 2, "so sudden"
    begin = loop.q
    for _ in range(100):
        loop.v = np.full(N, 2.0)
        loop.step()
    assert np.abs(loop.q - begin).max() > 0.15
    assert loop.additional.skipped == 2


def test_steps_are_bounded_whatever_velocity_does():
    """Of (C + K) s the increment of s changes K s by at most 2 lambda dt tau_max."""
    rng = np.random.default_rng(4)
    loop = IntegralLoop(
        "joints", budget=np.full(N, np.inf), slow_leak_rate=0.0, fast_leak_rate=0.0
    )
    bound = 2.0 * LAMBDA * DT
    largest, before = 0.0, np.zeros(N)
    for _ in range(2000):
        v = rng.uniform(-1.0, 1.0, N) * ARM.v_max * rng.choice([1e-3, 0.01, 0.1, 1.0])
        loop.robot.update(State(ARM.q_start, v), REST)
        loop.additional.torque(loop.robot, v, rng.uniform(-20.0, 20.0, N), DT)
        K_s = loop.additional.actions["joints"].s * LAMBDA * np.diagonal(loop.robot.M)
        largest, before = max(largest, relative(K_s - before)), K_s
    assert 0.5 * bound < largest
    # The mass matrix is that of the middle of the step, which differs by what v dt / 2 does.
    assert largest < 1.1 * bound
    assert 0 < loop.additional.skipped < 2000


# Initialising


@pytest.mark.parametrize("mode", MODES)
def test_it_begins_with_the_torque_it_is_told(mode):
    rng = np.random.default_rng(5)
    for _ in range(20):
        loop = IntegralLoop(mode)
        torque = rng.uniform(-0.3, 0.3, N) * ARM.tau_max
        loop.robot.update(State(loop.q, REST), REST)
        np.testing.assert_array_equal(loop.additional.initialise(loop.robot, REST, torque), torque)
        assert not loop.additional.idle
        after = loop.additional.torque(loop.robot, REST, REST, DT)
        # 1 / 0.2 s of what cannot be kept, 1 / 1 s of what is beyond the budget.
        assert relative(after - torque) <= 0.01


def test_a_joint_s_budget_is_widened_only_where_it_must():
    loop = IntegralLoop("joints")
    loop.robot.update(State(loop.q, REST), REST)
    torque = 0.5 * BUDGET
    torque[3] = 2.0 * BUDGET[3]
    loop.additional.initialise(loop.robot, REST, torque)
    np.testing.assert_allclose(
        loop.additional.actions["joints"].memory.widening,
        [0, 0, 0, BUDGET[3], 0, 0, 0],
        atol=1e-12,
    )


def test_what_cannot_be_initialised_fades():
    loop = IntegralLoop("joints")
    loop.robot.update(State(loop.q, REST), REST)
    loop.robot.C = -LAMBDA * np.diag(np.diagonal(loop.robot.M))  # C + K is singular
    torque = 0.1 * ARM.tau_max
    np.testing.assert_array_equal(loop.additional.initialise(loop.robot, REST, torque), torque)
    after = loop.additional.torque(loop.robot, REST, REST, DT)
    np.testing.assert_allclose(after, torque * math.exp(-DT / 0.2), rtol=1e-9)


# Whatever comes


NUMBERS = st.one_of(
    st.floats(-3.0, 3.0),
    st.floats(allow_nan=False, allow_infinity=False),
    st.sampled_from([math.nan, math.inf, -math.inf, 1e308, -1e308, 5e-324, 0.0]),
)
VECTORS = st.one_of(st.just(REST), arrays(float, N, elements=NUMBERS))
STEPS = st.lists(
    st.tuples(
        VECTORS,
        VECTORS,
        VECTORS,
        st.one_of(st.just(DT), NUMBERS),
        st.sampled_from([None, *MODES]),
        st.sampled_from([0.0, 1.0, 5.0]),
    ),
    min_size=1,
    max_size=8,
)


@settings(max_examples=150, deadline=None, derandomize=True)
@given(first=st.sampled_from(MODES), steps=STEPS)
def test_it_is_finite_and_never_raises(first, steps):
    robot = ARM.robot(DT)
    robot.rates = True
    additional = AdditionalTorque(make_settings(first), POSITION)
    with np.errstate(all="ignore"):
        for q, v, a, elapsed, mode, theta in steps:
            if mode is not None:
                additional.settings = replace(
                    make_settings(mode, slow_leak_rate=theta), disturbance_max=1e9 * ARM.tau_max
                )
            robot.update(State(ARM.q_start + q, v), a)
            torque = additional.torque(robot, v, a, elapsed)
            assert torque.shape == (N,)
            assert np.isfinite(torque).all()
            assert (np.abs(torque) <= 2.0 * BUDGET).all()
        # And it comes round.
        rest = State(ARM.q_start, REST), REST
        robot.update(*rest)
        for _ in range(4):
            additional.torque(robot, REST, REST, DT)
        skipped = additional.skipped
        for _ in range(3):
            additional.torque(robot, REST, REST, DT)
        assert additional.skipped == skipped
