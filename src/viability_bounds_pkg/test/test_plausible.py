# SPDX-License-Identifier: Apache-2.0
"""States that cannot be are refused, and those that can be are not."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from viability_bounds_pkg.plausible import PlausibilityCheck
from viability_bounds_pkg.state import State

N, LIMIT, NONE = 4, np.full(4, 2.5), np.zeros(4)
WINDOW = 0.2  # s, in which positions and velocities must agree again
OUTSIDE = "beyond a limit by more than the range of the joint"
TOO_FAST = "more than 10 times faster than the speed limit"
JUMP = "a position jumped"
CONTRADICTION = "positions contradict velocities"


def make_check(h=0.002, velocity_error=NONE, limit=LIMIT, position_error=NONE):
    return PlausibilityCheck(-limit, limit, np.full(N, 2.0), h, position_error, velocity_error)


def sine(t, size=0.75, w=2.0):
    """Return a motion in which all joints differ."""
    k = np.arange(1, N + 1)
    return State(size * np.sin(w * t + k), size * w * np.cos(w * t + k))


def play(check, spoil, h=0.002, end=1.6, last=3.0):
    """Return the times at which states were refused, with the reason; spoilt from 1 s on.

    The arm stops within 0.25 s where states are refused, and goes on when they are accepted.
    """
    refused, along, pace = [], 0.0, 1.0
    for k in range(round(last / h)):
        q, v = sine(along)
        state = State(q, pace * v)
        if 1.0 <= k * h < end:
            state = spoil(state)
        reason = check.fault(state, 5.0 + k * h)
        if reason:
            refused.append((k * h, reason))
        faster = min(max(pace + (-4.0 if reason else 4.0) * h, 0.0), 1.0)
        along += 0.5 * (pace + faster) * h
        pace = faster
    return refused


JOINT = np.eye(N)[2]


def frozen_joint(state):
    return state._replace(q=np.where(JOINT == 1.0, sine(1.0).q, state.q))


SPOILT = {
    "degrees": (lambda state: State(57.3 * state.q, 57.3 * state.v), OUTSIDE, 0.0),
    "far too fast": (lambda state: state._replace(v=1e200 * state.v), TOO_FAST, 0.0),
    "a position leaps": (lambda state: state._replace(q=state.q + 0.4 * JOINT), JUMP, 0.0),
    "a biased velocity": (lambda state: state._replace(v=state.v + JOINT), CONTRADICTION, WINDOW),
    "at rest elsewhere": (lambda state: State(0.0 * state.q - 3.0, 0.0 * state.v), JUMP, 0.0),
    "frozen": (lambda state: sine(1.0), CONTRADICTION, 0.06),
    "frozen positions": (lambda state: state._replace(q=sine(1.0).q), CONTRADICTION, 0.06),
    "a frozen position": (frozen_joint, CONTRADICTION, 0.15),
}


@pytest.mark.parametrize("h", [0.002, 0.01])
@pytest.mark.parametrize("name", SPOILT)
def test_what_cannot_be_is_refused_and_what_comes_afterwards_is_accepted(name, h):
    spoil, reason, within = SPOILT[name]
    longest = 2.0 * WINDOW
    refused = play(make_check(h), spoil, h, last=2.1 + longest)
    first, why = refused[0]
    assert why == reason and 1.0 - 1e-9 <= first <= 1.0 + within + 2.0 * h
    assert refused[-1][0] <= 1.6 + longest + h


@pytest.mark.parametrize("name", ["frozen", "degrees", "at rest elsewhere"])
def test_what_stays_impossible_stays_refused(name):
    spoil, _, within = SPOILT[name]
    refused = play(make_check(h=0.01), spoil, 0.01, end=6.0, last=6.0)
    assert len(refused) >= round((5.0 - within) / 0.01) - 1


def test_one_impossible_state_costs_no_other():
    check = make_check()
    assert not any(check.fault(sine(k * 0.002), k * 0.002) for k in range(500))
    q, v = sine(1.0)
    assert check.fault(State(q + 0.3, v), 1.0) == JUMP
    assert check.fault(sine(1.002), 1.002) == ""


def test_after_a_gap_in_the_stamps_an_arm_may_be_elsewhere():
    check, elsewhere = make_check(), State(np.full(N, -1.0), NONE)
    assert check.fault(sine(0.0), 1.0) == ""
    assert check.fault(elsewhere, 1.0 + 0.1 + 1e-3) == ""
    assert check.fault(sine(0.0), 1.0) == "not later than the last one"
    check.reset()
    assert check.fault(sine(0.0), 1.0) == ""


def test_an_impact_while_states_are_lost_is_accepted():
    check = make_check()
    for k in [*range(100), *range(120, 200)]:
        t, v = 0.002 * k, -2.0 if k < 100 else 2.0
        state = State(np.full(N, 2.0 * abs(t - 0.2)), np.full(N, v))
        assert check.fault(state, t) == "", k


def test_velocities_that_are_not_used_are_not_checked():
    check, rng = make_check(velocity_error=None), np.random.default_rng(0)
    assert not play(check, lambda state: State(state.q, 1e200 * rng.standard_normal(N)), last=1.6)
    check.reset()
    assert play(check, SPOILT["a position leaps"][0], last=1.1)[0][1] == JUMP


def test_joints_without_limits_may_turn_for_ever():
    check = make_check(limit=np.full(N, np.inf))
    turns = [State(np.full(N, 200.0 + 0.004 * k), np.full(N, 2.0)) for k in range(300)]
    assert not any(check.fault(turn, 0.002 * k) for k, turn in enumerate(turns))


@settings(deadline=None, max_examples=12, derandomize=True)
@given(
    h=st.sampled_from([0.001, 0.002, 0.01]),
    lag=st.sampled_from([0.0, 0.001, 0.003]),
    resolution=st.sampled_from([0.0, 1e-4, 1e-3]),
    used=st.booleans(),
    lost=st.sampled_from([0.0, 0.3]),
    seed=st.integers(0, 1000),
)
def test_violent_motions_impacts_filters_and_encoders_are_accepted(
    h, lag, resolution, used, lost, seed
):
    """Accelerations of up to 60 rad/s^2, hits, and stops of all joints within one period."""
    rng = np.random.default_rng(seed)
    check = make_check(h, NONE if used else None, np.full(N, np.inf), np.full(N, 0.5 * resolution))
    (q, v, seen), a = np.zeros((3, N)), np.zeros(N)
    for k in range(round(1.0 / h)):
        if k % round(0.1 / h) == 0:
            a = rng.uniform(-60.0, 60.0, N)
        q, v = State(q, v).after(np.clip(a, (-2.0 - v) / h, (2.0 - v) / h), h)
        if rng.random() < 0.02:
            hit = rng.uniform(-2.0, 2.0, N) if rng.random() < 0.7 else NONE
            q, v = q + rng.random() * h * (hit - v), hit
        seen = v + np.exp(-h / lag) * (seen - v) if lag else v
        told = resolution * np.round(q / resolution) if resolution else q
        if rng.random() >= lost:
            assert check.fault(State(told, seen.copy()), 7.0 + k * h) == ""
