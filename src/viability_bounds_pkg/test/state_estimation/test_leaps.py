# SPDX-License-Identifier: Apache-2.0
"""Positions that have leapt are believed when they have leapt back."""

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from sample_arm import NONE, N
from spoilt_states import LIMIT, H, leap, make_check, play, refused_at, sine, swapped

from viability_bounds_pkg.state import State
from viability_bounds_pkg.state_estimation.state_check import (
    EXCHANGED,
    GAP,
    OUTSIDE,
    STUCK,
    WINDOW,
)


@pytest.mark.parametrize("time", [0.6, 2.0])
def test_what_froze_untold_as_the_arm_crept_is_believed_when_it_goes_on(time):
    """Positions leap then, by 3 and 10 mrad, and do not leap back."""

    def creeps(t):
        return sine(t) if t < 2.5 else State(sine(2.5).q + 0.005 * (t - 2.5), NONE + 0.005)

    frozen = []

    def freezes(state, t):
        frozen.append(state)
        return frozen[0]

    refused = play(make_check(), freezes, 3.0, 3.0 + time, 6.0, motion=creeps)
    assert refused[0][0] == pytest.approx(3.0 + time, abs=1.1 * H)
    assert refused[-1][0] < 3.0 + time + 3.0 * WINDOW


def test_standing_joints_that_are_exchanged_are_not_taken_for_frozen_ones():
    """Sensors are not known yet, and positions are the same to the last bit before."""
    stands = State(np.linspace(-0.5, 0.5, N), NONE)
    times = refused_at(play(make_check(), swapped, 0.5, 1.5, 3.0, motion=lambda t: stands))
    assert times[0] == pytest.approx(0.5, abs=1.1 * H)
    assert 1.5 < times[-1] < 1.5 + 2.0 * WINDOW
    assert times.size == round((times[-1] - times[0]) / H) + 1


@pytest.mark.parametrize("size", [0.02, -0.3])
@pytest.mark.parametrize("joints", [slice(2, 3), slice(None)], ids=["one", "all"])
@pytest.mark.parametrize("velocity_error", [NONE, None], ids=["with velocities", "without"])
def test_positions_that_get_a_bias_as_the_arm_stands_are_not_taken_for_frozen_ones(
    size, joints, velocity_error
):
    """Where all is the same to the last bit, too: velocities lead nowhere."""

    def stops(t):
        return sine(min(t, 2.5)) if t < 2.5 else State(sine(2.5).q, NONE)

    def biased(state, t):
        q = state.q.copy()
        q[joints] += size
        return state._replace(q=q)

    check = make_check(velocity_error=velocity_error)
    times = refused_at(play(check, biased, 3.0, 5.0, 6.0, motion=stops))
    assert times[0] == pytest.approx(3.0, abs=1.1 * H)
    assert 5.0 < times[-1] < 5.0 + 2.0 * WINDOW
    assert times.size == round((times[-1] - times[0]) / H) + 1


@pytest.mark.parametrize("time", [0.6, 4.0])
def test_what_froze_before_sensors_are_known_is_believed_when_it_goes_on(time):
    def creeps(t):
        return State(np.linspace(-0.5, 0.5, N) + 0.005 * t, NONE + 0.005)

    frozen = []

    def freezes(state, t):
        frozen.append(state)
        return frozen[0]

    refused = play(make_check(), freezes, 0.3, 0.3 + time, 6.0, motion=creeps)
    assert not refused or refused[-1][0] < 0.3 + time + 3.0 * WINDOW


@settings(max_examples=30, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    h=st.sampled_from([H, 0.01]),
    size=st.floats(0.0, 0.3),
    duration=st.floats(0.15, 1.0),
    begin=st.floats(-0.2, 1.0),
    time=st.floats(0.02, 1.2),
)
@example(0, 0.01, 0.1, 0.4, -0.2, 0.7)
@example(0, 0.01, 0.3, 0.25, -0.2, 0.6)
def test_however_far_the_arm_moved_as_its_positions_froze_untold_they_are_believed(
    seed, h, size, duration, begin, time
):
    """It moves once, and sensors are not known: it may come to rest before anything is told."""
    rng = np.random.default_rng(seed)
    ways = size * rng.uniform(-1.0, 1.0, N) * (rng.uniform(size=N) < rng.choice([0.3, 1.0]))

    def moves(t):
        s = min(max((t - 0.5) / duration, 0.0), 1.0)
        q = np.linspace(-0.5, 0.5, N) + ways * (s - np.sin(2.0 * np.pi * s) / (2.0 * np.pi))
        return State(q, ways / duration * (1.0 - np.cos(2.0 * np.pi * s)))

    frozen = []

    def freezes(state, t):
        frozen.append(state.q)
        return state._replace(q=frozen[0])

    end = 0.5 + begin * duration + time
    refused = play(make_check(), freezes, end - time, end, end + 2.0, h, moves)
    assert not refused or refused[-1][0] < end + 5.0 * WINDOW


@pytest.mark.parametrize("size", [0.001, 0.02, -0.3])
def test_what_leapt_is_believed_when_it_has_leapt_back(size):
    times = refused_at(play(make_check(), leap(size), 2.0, 2.6, 4.0))
    assert times[0] == pytest.approx(2.0, abs=1.1 * H)
    assert 2.6 + 0.5 * WINDOW < times[-1] < 2.6 + 2.0 * WINDOW + 0.01
    assert times.size == round((times[-1] - times[0]) / H) + 1  # none in between is believed


@pytest.mark.parametrize("size", [0.02, -0.3])
def test_a_leap_that_stays_is_believed_after_a_gap_only(size):
    check, last = make_check(), 3.0 + STUCK
    times = refused_at(play(check, leap(size), 2.0, np.inf, last))
    assert times.size >= round((last - 2.0) / H) - 1
    assert not check.look(sine(3.0), 5.0 + last + 1.1 * GAP)


def test_a_leap_that_only_good_sensors_tell_is_believed_late():
    times = refused_at(play(make_check(), leap(0.001), 2.0, np.inf, 4.0 + STUCK))
    assert 1.9 + STUCK < times[-1] < 2.5 + STUCK
    assert times.size == round((times[-1] - times[0]) / H) + 1


def test_a_second_leap_that_is_not_back_does_not_count():
    """Where the arm stands: in motion it may have come as far. The last bits are noise."""

    def stops(t):
        return sine(t) if t < 2.5 else State(sine(2.5).q + 1e-9 * np.sin(1e4 * t), NONE)

    def twice(state, t):
        return leap(0.02 if t < 3.3 else 0.12)(state, t)

    times = refused_at(play(make_check(), twice, 3.0, np.inf, 5.0, motion=stops))
    assert times.size >= round(2.0 / H) - 1


@settings(max_examples=20, deadline=None)
@given(
    joints=st.permutations(range(N)).map(lambda order: order[:2]),
    first=st.integers(600, 800),
    phase=st.floats(0.0, 1.0),
    h=st.sampled_from([0.002, 0.01]),
)
def test_joints_that_are_exchanged_where_they_meet_are_told_at_once(joints, first, phase, h):
    """Somewhere in the period before the state that is the `first`: positions leap nowhere."""
    i, j = joints
    there = sine((first - phase) * h)
    assume(abs(there.v[i] - there.v[j]) > 0.1)
    shift = (there.q[i] - there.q[j]) * np.eye(N)[j]

    def meeting(t):
        return sine(t)._replace(q=sine(t).q + shift)

    order = np.arange(N)
    order[[i, j]] = j, i

    def exchanged(state, t):
        return State(state.q[order], state.v[order])

    begin, end = (first - 0.5) * h, (first - 0.5) * h + 0.4
    check = make_check(limit=np.full(N, 5.0))
    refused = play(check, exchanged, begin, end, end + 0.9, h, meeting)
    assert refused[0] == (pytest.approx(first * h), EXCHANGED)
    assert len([t for t, _ in refused if t < end]) == round(0.4 / h)
    # They have come apart while the arm stopped, so that they are seen to leap back.
    assert refused[-1][0] < end + 2.0 * WINDOW + 2.0 * h


def test_joints_that_are_exchanged_where_they_meet_are_told_after_torques_braked_hard():
    """By more in a period than their velocities differ: e stays small then."""
    h, first = 0.01, 703
    there = sine((first - 0.2) * h)
    apart = abs(there.v[0] - there.v[1])
    ramps = np.arange(5) * h + 3.0
    speeds = np.array([0.0, 1.0, 2.0, 1.0, 0.0]) * apart

    def meeting(t):
        """Both go on by a triangle of the speed."""
        q, v = sine(t)
        more = np.interp(t, ramps, speeds)
        along = np.interp(t, ramps, np.r_[0.0, 0.5, 2.0, 3.5, 4.0] * h * apart)
        shift = (there.q[0] - there.q[1]) * np.eye(N)[1]
        return State(q + shift + along, v + more)

    order = np.r_[1, 0, 2:N]

    def exchanged(state, t):
        return State(state.q[order], state.v[order])

    begin = (first - 0.5) * h
    refused = play(
        make_check(limit=np.full(N, 5.0)), exchanged, begin, begin + 0.4, begin + 1.3, h, meeting
    )
    assert 0.1 < apart < 1.5 and refused[0] == (pytest.approx(first * h), EXCHANGED)


def test_joints_that_are_exchanged_and_leave_their_range_are_seen_to_leap_back():
    size = np.r_[0.2, np.ones(N - 1)]

    def motion(t):
        return State(size * sine(t).q, size * sine(t).v)

    check = make_check(limit=np.r_[0.15, LIMIT[1:]])
    refused = play(check, swapped, 2.386, 3.0, 4.0, motion=motion)
    assert refused[0][0] == pytest.approx(2.386, abs=1.1 * H)
    assert [wrong for t, wrong in refused if t < 3.0][-1] == OUTSIDE
    assert 3.0 < refused[-1][0] < 3.0 + 2.0 * WINDOW
    assert len(refused) == round((refused[-1][0] - refused[0][0]) / H) + 1


@pytest.mark.parametrize("begin", [3.15, 3.3])
def test_exchanged_joints_that_are_out_of_range_at_first_are_never_believed(begin):
    """They come back into it while the arm stops, and are as wrong there."""
    size, shift = np.r_[0.1, np.full(N - 1, 0.6)], 0.4 * np.eye(N)[1]

    def motion(t):
        return State(size * sine(t).q + shift, size * sine(t).v)

    limit = np.r_[motion(begin).q[1] / 3.0 - 0.002, LIMIT[1:]]
    assert motion(begin + 0.1).q[1] < 3.0 * limit[0]  # where it is at least as it has stopped
    refused = play(make_check(limit=limit), swapped, begin, 4.0, 5.0, motion=motion)
    assert refused[0] == (pytest.approx(begin, abs=1.1 * H), OUTSIDE)
    assert 4.0 < refused[-1][0] < 4.0 + 2.0 * WINDOW
    assert len(refused) == round((refused[-1][0] - refused[0][0]) / H) + 1


@pytest.mark.parametrize("size", [1e3, 1e17, -1e308])
def test_nonsense_is_undone_by_the_next_state(size):
    def to_and_fro(state, t):
        return leap(size * (1.0 if t < 1.0 + 0.5 * H else -1.0))(state, t)

    with np.errstate(all="raise"):
        refused = play(make_check(), to_and_fro, 1.0, 1.0 + 1.5 * H)
    assert [wrong for _, wrong in refused] == [OUTSIDE, OUTSIDE]


@pytest.mark.parametrize("begin", [1.5, (2.0 * np.pi - 3.0) / 2.0])
def test_units_that_change_are_undone_for_all_joints_at_once(begin):
    """What is at zero as they change, or change back, leaps too little then to be seen."""

    def motion(t):
        q, v = sine(t)
        if begin == 1.5:  # and is at zero as the arm has stopped
            left = max(begin + 0.06 - t, 0.0)
            q[2], v[2] = left, -1.0 if left else 0.0
        return State(q, v)

    def degrees(state, t):
        return State(57.3 * state.q, 57.3 * state.v)

    refused = play(make_check(), degrees, begin, begin + 0.6, begin + 2.0, motion=motion)
    assert refused[-1][0] < begin + 0.6 + 2.0 * WINDOW
    assert len(refused) == round((refused[-1][0] - refused[0][0]) / H) + 1


@pytest.mark.parametrize("size", [0.03, 0.3, -0.3])
def test_a_leap_that_stays_as_nonsense_of_another_joint_ends_is_not_believed(size):
    def two(state, t):
        q = state.q + size * np.eye(N)[2]
        return state._replace(q=q + (10.0 * np.eye(N)[0] if t < 1.6 else 0.0))

    refused = play(make_check(), two, end=2.2, last=4.0)
    assert [wrong for t, wrong in refused if t < 1.6][-1] == OUTSIDE
    assert 2.2 < refused[-1][0] < 2.2 + 2.0 * WINDOW
    assert len(refused) == round((refused[-1][0] - refused[0][0]) / H) + 1


@pytest.mark.parametrize("known", [False, True])
def test_a_bias_of_velocities_that_begins_as_a_joint_comes_to_rest_is_not_one_that_froze(known):
    """Its position is the same afterwards, though it seemed to move: its velocity says why."""
    begin = 2.0 if known else 0.4

    def comes_to_rest(t):
        q, v = sine(t)
        rest = sine(begin).q
        q[2], v[2] = (q[2], v[2]) if t < begin else (rest[2], 0.0)
        return State(q, v)

    def biased(state, t):
        return state._replace(v=state.v + (0.6 if t > begin + 0.5 * H else 0.0))

    times = refused_at(play(make_check(), biased, begin, begin + 0.6, 6.0, motion=comes_to_rest))
    assert begin + 0.6 < times[-1] < begin + 0.6 + 3.0 * WINDOW
