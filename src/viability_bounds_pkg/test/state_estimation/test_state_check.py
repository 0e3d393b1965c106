# SPDX-License-Identifier: Apache-2.0
"""States that cannot be are told, and those that can be are not."""

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from sample_arm import MODEL, NONE, TAU_MAX, N

from viability_bounds_pkg.state import State
from viability_bounds_pkg.state_estimation.state_check import (
    CONTRADICTION,
    EXCHANGED,
    GAP,
    JUMP,
    ONCE_MORE,
    OUTSIDE,
    STUCK,
    TOO_FAST,
    UNDECIDED,
    WINDOW,
    StateCheck,
    largest_accelerations,
)

A = largest_accelerations(MODEL, TAU_MAX)
LIMIT = np.full(N, 2.5)
H = 0.002


def make_check(velocity_error=NONE, limit=LIMIT):
    return StateCheck(MODEL, -limit, limit, TAU_MAX, NONE, velocity_error)


def sine(t, size=0.75, w=2.0):
    """Return a motion in which all joints differ."""
    k = np.arange(1, N + 1)
    return State(size * np.sin(w * t + k), size * w * np.cos(w * t + k))


def play(check, spoil, begin=1.0, end=1.6, last=3.0, h=H, motion=sine):
    """Return the times at which states were refused, with what was wrong.

    The arm stops within 0.25 s where states are refused, and goes on when they are believed.
    """
    refused, along, pace = [], 0.0, 1.0
    for k in range(round(last / h)):
        t = k * h
        state = motion(along)
        state = state._replace(v=pace * state.v)
        if begin <= t < end:
            state = spoil(state, t)
        wrong = check.look(state, 5.0 + t)
        if wrong:
            refused.append((t, wrong))
        faster = min(max(pace + (-4.0 if wrong else 4.0) * h, 0.0), 1.0)
        along += 0.5 * (pace + faster) * h
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


def test_positions_that_stay_frozen_are_believed_late_and_told_again():
    """Where the arm stands what is frozen agrees, and the arm begins to move."""

    held = []

    def frozen(state, t):
        held.append(state.q)
        return state._replace(q=held[0])

    refused = [t for t, _ in play(make_check(), frozen, 1.0, 30.0, 30.0)]
    believed = np.flatnonzero(np.diff(refused) > 1.5 * H)
    assert 3 < believed.size <= 6  # less and less often, once it stands
    assert refused[believed[0]] - 1.0 > STUCK
    assert np.diff(refused).max() < 0.2  # how long the arm moved then
    # Those that change again are believed sooner.
    held.clear()
    assert play(make_check(), frozen, 1.0, 5.0, 10.0)[-1][0] < 5.0 + 3.0 * WINDOW


@pytest.mark.parametrize("b", [-2.0, -0.2, 0.1, 0.6])
def test_a_bias_of_good_velocities_is_undecided_at_first_and_told_by_the_second(b):
    refused = play(make_check(), lambda state, t: state._replace(v=state.v + b))
    assert refused[0] == (pytest.approx(1.0), UNDECIDED)
    assert refused[1] == (pytest.approx(1.0 + H), CONTRADICTION)
    # It is never believed, also where the arm stands.
    assert len([t for t, _ in refused if t < 1.6]) == round(0.6 / H)


def test_positions_that_freeze_are_told_by_the_second_state():
    refused = play(make_check(), lambda state, t: state._replace(q=sine(1.0).q), begin=1.002)
    assert [wrong for _, wrong in refused[:2]] == [UNDECIDED, CONTRADICTION]
    assert refused[1][0] == pytest.approx(1.004)


def test_positions_that_froze_before_sensors_are_known_are_believed_when_they_go_on():
    """They are told late, and leap as they go on."""
    refused = play(make_check(), SPOILT["frozen positions"][0], 1.0, 1.6, 3.0, 0.01)
    assert refused[0][0] > 1.02 and 1.6 < refused[-1][0] < 1.6 + 2.0 * WINDOW + 0.02


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


def test_velocities_that_freeze_are_told_when_the_arm_is_faster_by_some_percent():
    refused = play(make_check(), lambda state, t: state._replace(v=sine(1.0).v), begin=1.002)
    change = np.abs(sine(refused[1][0]).v - sine(1.0).v)
    assert change.max() < 0.05 * 2.0


def looks(check, states, stamps=None):
    """Return what states are said to be, H apart or at these times."""
    times = 5.0 + H * np.arange(len(states)) if stamps is None else stamps
    return [check.look(*each) for each in zip(states, times, strict=True)]


def test_an_impact_costs_one_state_and_rattling_one_in_a_while():
    check = make_check()
    states = [sine(k * H) for k in range(500)]
    assert not any(looks(check, states))
    q, v = states[-1]
    # It hits at the end of a period, and rattles from then on.
    rattle, way = [], q + H * v
    for k in range(1000):
        rattle.append(State(way, v))
        v_next = v * (0.5 if k % 20 == 0 else 2.0 if k % 20 == 10 else 1.0)
        way, v = way + H * v, v_next
    said = looks(check, rattle, 5.0 + H * np.arange(500, 1500))
    assert set(said) == {"", UNDECIDED}
    assert 1 <= said.count(UNDECIDED) <= 1000 * H / WINDOW + 1
    undecided = np.flatnonzero([wrong == UNDECIDED for wrong in said])
    assert (np.diff(undecided) > 1).all()


def test_a_stamp_that_comes_late_costs_one_state_at_most():
    check = make_check()
    states, stamps = [sine(k * H) for k in range(1000)], 5.0 + H * np.arange(1000)
    stamps[700] += 0.4 * H
    said = looks(check, states, stamps)
    assert said[700] == UNDECIDED and said.count("") == 999


def test_torques_that_change_while_states_are_lost_are_believed():
    """The time between two states is that of the last ones but for some."""
    check, v, q = make_check(), np.zeros(N), np.zeros(N)
    rng, states, stamps = np.random.default_rng(5), [], []
    for k in range(4000):
        a = 15.0 * np.sign(np.sin(2.0 * np.pi * k / 50.0 + np.arange(N)))
        q, v = State(q, v).after(a, H)
        if k < 500 or rng.random() > 0.5:
            states.append(State(q, v))
            stamps.append(5.0 + k * H)
    assert not any(looks(check, states, np.array(stamps)))


@pytest.mark.parametrize("lag", [0.0, 0.002, 0.005])
def test_filters_are_believed_also_when_the_arm_becomes_violent(lag):
    check = make_check(limit=np.full(N, np.inf))
    rng, (q, v, seen) = np.random.default_rng(6), np.zeros((3, N))
    for k in range(5000):
        if k % 100 == 0:
            a = rng.uniform(-1.0, 1.0, N) * (2.0 if k < 2000 else 20.0)
        q, v = State(q, v).after(np.clip(a, (-2.0 - v) / H, (2.0 - v) / H), H)
        seen = v + np.exp(-H / lag) * (seen - v) if lag else v
        assert not check.look(State(q, seen), 7.0 + k * H)


def test_a_share_that_was_learned_hardly_grows_afterwards():
    """A bias that grows within some states does not teach that it is right."""
    check = make_check()

    def grows(state, t):
        return state._replace(v=state.v + 0.003 * (t - 1.0) / H)

    (first, _), (second, wrong) = play(check, grows)[:2]
    assert 0.003 * (second - 1.0) / H < 0.05 and wrong == CONTRADICTION and first < second


def test_reasons():
    def reason(spoil):
        return next(wrong for _, wrong in play(make_check(), spoil) if wrong != UNDECIDED)

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
    undecided = False
    change = rng.random()  # when in a period a new torque begins to act
    for k in range(round(2.0 / h)):
        q, v = State(q, v).after(a, change * h)
        a = np.clip(rng.choice([-1.0, 0.0, 1.0], N) * most, (-2.0 - v) / h, (2.0 - v) / h)
        q, v = State(q, v).after(a, (1.0 - change) * h)
        if rng.random() < h / 0.5:
            v = -0.3 * v  # hits a wall
        seen = v + np.exp(-h / lag) * (seen - v) if lag else v
        read = State(np.round(q / 1e-4) * 1e-4, seen + rng.uniform(-0.02, 0.02, N))
        wrong = check.look(read, 7.0 + k * h)
        assert wrong in ("", UNDECIDED) and not (wrong and undecided)
        undecided = wrong == UNDECIDED


def leap(size):
    """Return what adds to the position of one joint, rad."""
    return lambda state, t: state._replace(q=state.q + size * np.eye(N)[2])


def refused_at(refused):
    """Return when states were refused, undecided ones left out, s."""
    return np.array([t for t, wrong in refused if wrong != UNDECIDED])


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


@pytest.mark.parametrize("size", [-0.6 * H, 0.1 * H, 0.6 * H, 0.01, 0.09])
def test_stamps_that_leap_in_motion_cost_a_moment(size):
    """Positions seem to leap where it is the clock, which does not leap back."""
    check = make_check()
    stamps = 5.0 + H * np.arange(2000)
    stamps[1000:] += size
    said = looks(check, [sine(k * H) for k in range(2000)], stamps)
    assert not any(said[round(1000 + 2.5 * WINDOW / H) :])


def test_a_leap_in_the_way_of_the_only_joint_that_moves_is_no_clock_that_was_set():
    """In another time it would have come as far, but that time was not heard."""
    check = make_check()
    for k in range(1000):
        q, v = sine(k * H)
        state = State(np.where(np.arange(N) == 2, q, 0.1), np.where(np.arange(N) == 2, v, 0.0))
        late = 0.6 * H * (k % 2)
        wrong = check.look(
            (leap(0.02) if k >= 700 else lambda s, t: s)(state, 0), k * H, k * H + late
        )
        assert (wrong not in ("", UNDECIDED)) == (k >= 700), k


@pytest.mark.parametrize("times", [0.8, 1.3, 57.3])
@pytest.mark.parametrize("joints", [slice(2, 3), slice(None)], ids=["one", "all"])
def test_velocities_in_other_units_are_not_taken_for_a_clock_that_was_set(times, joints):
    """In each period anew positions move as in another time."""
    moves = np.zeros(N)
    moves[joints] = 1.0

    def motion(t):
        return State(moves * sine(t).q, moves * sine(t).v)

    def other(state, t):
        return state._replace(v=times * state.v)

    refused = play(make_check(), other, motion=motion)
    assert refused_at(refused)[0] <= 1.0 + 1.1 * H


def test_a_gap_is_a_new_beginning():
    check = make_check()
    assert not check.look(sine(0.0), 1.0)
    assert check.look(sine(1.0), 1.0 + 0.9 * GAP) == JUMP
    assert not check.look(sine(2.0), 1.0 + 2.0 * GAP)
    assert not check.look(sine(3.0), 0.5)  # a robot that begins again


@pytest.mark.parametrize("other", ["values", "stamp", "nothing"])
def test_a_state_that_comes_again_and_again_is_that_of_a_robot_that_waits(other):
    check = make_check()
    for k in range(300):
        assert not check.look(sine(k * H), 5.0 + k * H)
    there, stamp = sine(2.0), 5.0 + 300 * H
    assert check.look(there, stamp) == JUMP
    for k in range(ONCE_MORE - 1):
        assert check.look(there, stamp) == JUMP, k
    if other == "values":
        assert check.look(sine(2.1), stamp) == JUMP
    elif other == "stamp":
        assert check.look(there, stamp + H)
    else:
        assert not check.look(there, stamp)
        assert not check.look(sine(2.0 + H), stamp + H)


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
