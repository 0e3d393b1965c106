# SPDX-License-Identifier: Apache-2.0
"""States that cannot be are told, and those that can be are not."""

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from viability_bounds_pkg.state import State
from viability_bounds_pkg.state_estimation.state_check import (
    CONTRADICTION,
    GAP,
    JUMP,
    OUTSIDE,
    TOO_FAST,
    WINDOW,
    StateCheck,
    largest_accelerations,
)

MODEL = pin.buildSampleModelManipulator()
N = MODEL.nv
MODEL.velocityLimit[:] = 2.0
TAU_MAX = np.full(N, 50.0)
A = largest_accelerations(MODEL, TAU_MAX)
NONE = np.zeros(N)
LIMIT = np.full(N, 2.5)
H = 0.002


def make_check(velocity_error=NONE, limit=LIMIT):
    return StateCheck(MODEL, -limit, limit, TAU_MAX, NONE, velocity_error)


def sine(t, size=0.75, w=2.0):
    """Return a motion in which all joints differ."""
    k = np.arange(1, N + 1)
    return State(size * np.sin(w * t + k), size * w * np.cos(w * t + k))


def play(check, spoil, begin=1.0, end=1.6, last=3.0):
    """Return the times at which states were refused, with what was wrong.

    The arm stops within 0.25 s where states are refused, and goes on when they are believed.
    """
    refused, along, pace = [], 0.0, 1.0
    for k in range(round(last / H)):
        t = k * H
        state = sine(along)
        state = state._replace(v=pace * state.v)
        if begin <= t < end:
            state = spoil(state, t)
        wrong = check.look(state, 5.0 + t)
        if wrong:
            refused.append((t, wrong))
        faster = min(max(pace + (-4.0 if wrong else 4.0) * H, 0.0), 1.0)
        along += 0.5 * (pace + faster) * H
        pace = faster
    return refused


def swapped(state, t):
    order = np.r_[1, 0, 2:N]
    return State(state.q[order], state.v[order])


SPOILT = {
    "degrees": (lambda state, t: State(57.3 * state.q, 57.3 * state.v), 0.0),
    "bias of positions": (lambda state, t: state._replace(q=state.q + 0.4), 0.0),
    "bias of velocities": (lambda state, t: state._replace(v=state.v + 0.6), WINDOW),
    "frozen": (lambda state, t: sine(1.0), 0.1),
    "frozen positions": (lambda state, t: state._replace(q=sine(1.0).q), 0.1),
    "swapped": (swapped, 0.0),
    "another arm": (lambda state, t: sine(t + 1.3), 0.0),
}


@pytest.mark.parametrize(("spoil", "within"), SPOILT.values(), ids=SPOILT)
def test_what_cannot_be_is_told_and_what_comes_afterwards_is_believed(spoil, within):
    refused = play(make_check(), spoil)
    first, last = refused[0][0], refused[-1][0]
    assert 1.0 - 1e-9 <= first <= 1.0 + within + 1e-9
    # Nearly all of it from then on, and none long after it.
    assert len([t for t, _ in refused if t < 1.6]) > 0.95 * (1.6 - first) / H
    assert last <= 1.6 + 2.0 * WINDOW + 0.01


def test_what_stays_frozen_is_believed_less_and_less_often():
    """Where the arm stands what is frozen agrees, and the arm begins to move."""

    def frozen(state, t):
        return state._replace(q=sine(1.0).q)

    refused = [t for t, _ in play(make_check(), frozen, 1.0, 30.0, 30.0)]
    believed = np.diff(refused) > 1.5 * H
    assert 3 < np.count_nonzero(believed) <= 6
    assert np.diff(refused).max() < 0.2  # how long the arm moved then


def test_reasons():
    def reason(spoil):
        return play(make_check(), spoil)[0][1]

    assert reason(SPOILT["degrees"][0]) == OUTSIDE
    assert reason(SPOILT["swapped"][0]) == JUMP
    assert reason(SPOILT["frozen positions"][0]) == CONTRADICTION


def test_a_speed_that_no_joint_has_is_told():
    check = make_check()
    assert check.look(State(NONE, np.full(N, 1e200)), 1.0) == TOO_FAST
    for k in range(1, round(WINDOW / H) + 4):
        wrong = check.look(State(NONE, NONE), 1.0 + k * H)
    assert not wrong


def test_one_wrong_message_costs_one_message():
    refused = play(make_check(), swapped, 1.0, 1.0 + 0.5 * H)
    assert [wrong for _, wrong in refused] == [JUMP]


def test_noise_that_is_not_declared_is_told():
    rng = np.random.default_rng(3)
    refused = play(
        make_check(), lambda state, t: state._replace(q=state.q + rng.normal(0, 0.1, N))
    )
    assert len(refused) > 290


@settings(max_examples=15)
@given(
    seed=st.integers(0, 2**32 - 1),
    h=st.sampled_from([0.001, 0.002, 0.01, 0.04]),
    lag=st.sampled_from([0.0, 0.002]),
)
def test_what_motors_and_impacts_can_do_is_believed(seed, h, lag):
    """Torques that change within a period, impacts, coarse encoders, late velocities."""
    rng = np.random.default_rng(seed)
    check, most = make_check(limit=np.full(N, np.inf)), A if lag == 0.0 else np.minimum(A, 20.0)
    q, v, a, seen = np.zeros((4, N))
    change = rng.random()  # when in a period a new torque begins to act
    for k in range(round(2.0 / h)):
        q, v = State(q, v).after(a, change * h)
        a = np.clip(rng.choice([-1.0, 0.0, 1.0], N) * most, (-2.0 - v) / h, (2.0 - v) / h)
        q, v = State(q, v).after(a, (1.0 - change) * h)
        if rng.random() < h / 0.5:
            v = -0.3 * v  # hits a wall
        seen = v + np.exp(-h / lag) * (seen - v) if lag else v
        read = State(np.round(q / 1e-4) * 1e-4, seen + rng.uniform(-0.02, 0.02, N))
        assert not check.look(read, 7.0 + k * h)


def test_a_gap_is_a_new_beginning():
    check = make_check()
    assert not check.look(sine(0.0), 1.0)
    assert check.look(sine(1.0), 1.0 + 0.9 * GAP) == JUMP
    assert not check.look(sine(2.0), 1.0 + 2.0 * GAP)
    assert not check.look(sine(3.0), 0.5)  # a robot that begins again


def test_where_velocities_are_not_known_jumps_are_told():
    check = make_check(velocity_error=None)

    def without(state, t):
        return State(state.q, NONE)

    assert not play(check, without, 0.0, 3.0)
    check = make_check(velocity_error=None)
    assert play(check, swapped)[0] == (1.0, JUMP)


def test_joints_without_limits_have_no_range():
    check = make_check(limit=np.full(N, np.inf))
    assert not check.look(State(np.full(N, 100.0), NONE), 1.0)


def test_the_largest_accelerations_are_not_passed():
    rng, data = np.random.default_rng(8), MODEL.createData()
    for _ in range(300):
        q, tau = rng.uniform(-np.pi, np.pi, N), rng.choice([-1.0, 1.0], N) * TAU_MAX
        a = np.linalg.solve(pin.crba(MODEL, data, q), tau)
        assert (np.abs(a) <= A).all()
