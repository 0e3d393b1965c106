# SPDX-License-Identifier: Apache-2.0
"""The integral action where time, velocity or state jump, or are no sensible numbers."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from integral_loop import (
    ARM,
    BUDGET,
    DT,
    LAMBDA,
    REST,
    IntegralLoop,
    N,
    make_settings,
    relative,
    settled,
)

from torque_safety_controller.integral_feedback import MODES
from torque_safety_controller.parts.integral import make_integral
from viability_bounds_pkg.state import State

# Time that jumps


GAPS = [10.0, 3600.0, 2.6 * DT, 0.0, -1.0, -1e9, 1e300, math.nan, math.inf, -math.inf]


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("gap", GAPS)
def test_time_may_jump(mode, gap):
    loop = settled(mode)
    loop.step(elapsed=gap)
    skipped = int(mode != "none")  # what only fades integrates nothing
    assert loop.action.skipped == skipped
    loop.run(0.05)
    # At most 1.25% of what is to fade, which is no more than the budget.
    assert loop.steps(51) < 0.0125 * 0.2
    assert loop.action.skipped == skipped


@pytest.mark.parametrize("gap", [0.5 * DT, 2.0 * DT])
def test_a_period_that_is_short_or_twice_as_long_is_integrated(gap):
    loop = settled("joints")
    loop.step(elapsed=gap)
    assert loop.action.skipped == 0
    assert loop.steps(1) < 1e-3


def test_the_memory_fades_while_time_jumps_again_and_again():
    """As when the robot sends a third of the states that it should."""
    loop = settled("joints")
    begin = loop.action.last
    for _ in range(2000):
        loop.step(elapsed=10.0 * DT)
        assert loop.steps(1) < 0.0125 * 0.2
    assert loop.action.skipped == 2000
    # 20 s at the slow rate of 0.1 1/s.
    assert relative(loop.action.last) < 0.2 * relative(begin)


def test_an_arm_that_stood_still_meanwhile_goes_on():
    loop = settled("joints")
    before = loop.action.last
    loop.v = REST  # its brakes held it for 2 s
    loop.step(elapsed=2.0)
    loop.run(0.1)
    assert loop.steps(101) < 0.0125 * 0.2
    assert loop.action.skipped == 1
    np.testing.assert_allclose(loop.action.last, before, atol=0.02 * ARM.tau_max.max())


# Velocity that jumps, states that are far away


@pytest.mark.parametrize("mode", ["joints", "task"])
@pytest.mark.parametrize("size", [10.0, -300.0, 1e100, 1e308])
def test_a_glitch_of_the_velocity_is_not_integrated(mode, size):
    loop, other = settled(mode), settled(mode)
    seen = loop.v.copy()
    seen[2] += size
    before = loop.action.last
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
    assert relative(loop.action.last - other.action.last) > 0.04


def test_numbers_beyond_sense_keep_the_last_torque():
    for mode in MODES:
        for bad in (math.nan, math.inf, -math.inf):
            loop = settled(mode)
            before = loop.action.last
            seen = loop.v.copy()
            seen[0] = bad
            with np.errstate(all="ignore"):
                loop.robot.update(State(loop.q, seen), loop.a)
            added = loop.action.torque(loop.robot, loop.a, DT)
            np.testing.assert_array_equal(added, before)
            loop.run(0.02)
            assert loop.steps(21) < 1e-3
            # Since when the velocity has changed is not known in the next step either.
            assert loop.action.skipped == (0 if mode == "none" else 2)


@pytest.mark.parametrize("mode", MODES)
def test_a_beginning_with_numbers_beyond_sense_is_put_off(mode):
    loop = IntegralLoop(mode)
    seen = np.full(N, math.nan)
    with np.errstate(all="ignore"):
        loop.robot.update(State(loop.q, seen), loop.a)
    np.testing.assert_array_equal(loop.action.torque(loop.robot, loop.a, DT), REST)
    loop.action.settings = make_settings(gain=20.0)
    np.testing.assert_array_equal(loop.action.torque(loop.robot, loop.a, DT), REST)
    loop.run(0.4)
    assert relative(loop.action.last) > 0.02 or mode == "none"


@pytest.mark.parametrize("mode", ["joints", "position"])
def test_a_state_far_away_kicks_no_joint(mode):
    """The arm is put elsewhere, as by a reset: other inertias, and far from its reference."""
    rng = np.random.default_rng(3)
    for _ in range(10):
        loop = settled(mode)
        loop.q, _ = ARM.random_state(rng)
        loop.v, before = REST, loop.action.last
        np.testing.assert_array_equal(loop.step(), before)
        assert loop.action.skipped == 1
        loop.run(0.3)
        # Then it grows, no faster than the accelerations that are asked for.
        assert loop.steps(300) < 2.0 * LAMBDA * DT
        assert (np.abs(loop.action.last) <= 1.3 * BUDGET).all()


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
        loop.action.torque(loop.robot, rng.uniform(-20.0, 20.0, N), DT)
        K_s = loop.action.law.s * LAMBDA * np.diagonal(loop.robot.M)
        largest, before = max(largest, relative(K_s - before)), K_s
    assert 0.5 * bound < largest
    # The mass matrix is that of the middle of the step, which differs by what v dt / 2 does.
    assert largest < 1.1 * bound
    assert 0 < loop.action.skipped < 2000


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
        st.sampled_from([None, 0.0, 1.0, 5.0]),
    ),
    min_size=1,
    max_size=8,
)


@settings(max_examples=150, deadline=None, derandomize=True)
@given(mode=st.sampled_from(MODES), steps=STEPS)
def test_it_is_finite_and_never_raises(mode, steps):
    robot = ARM.robot(DT)
    robot.rates = True
    action = make_integral(mode, make_settings(), 1e9 * ARM.tau_max)
    with np.errstate(all="ignore"):
        for q, v, a, elapsed, theta in steps:
            if theta is not None:
                action.settings = make_settings(slow_leak_rate=theta)
            robot.update(State(ARM.q_start + q, v), a)
            torque = action.torque(robot, a, elapsed)
            assert torque.shape == (N,)
            assert np.isfinite(torque).all()
            assert (np.abs(torque) <= 2.0 * BUDGET).all()
        # And it comes round.
        rest = State(ARM.q_start, REST), REST
        robot.update(*rest)
        for _ in range(4):
            action.torque(robot, REST, DT)
        skipped = action.skipped
        for _ in range(3):
            action.torque(robot, REST, DT)
        assert action.skipped == skipped
