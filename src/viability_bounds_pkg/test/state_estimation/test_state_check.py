# SPDX-License-Identifier: Apache-2.0
"""States that cannot be are told, and those that can be are not."""

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sample_arm import MODEL, NONE, TAU_MAX, N
from spoilt_states import H, leap, looks, make_check, play, refused_at, sine, swapped

from viability_bounds_pkg.state import State
from viability_bounds_pkg.state_estimation.state_check import (
    CONTRADICTION,
    GAP,
    JUMP,
    ONCE_MORE,
    OUTSIDE,
    STUCK,
    TOO_FAST,
    UNDECIDED,
    WINDOW,
    largest_accelerations,
)

A = largest_accelerations(MODEL, TAU_MAX)


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


def test_an_arm_that_is_farther_than_a_stop_leads_is_believed_late():
    """Weak motors take their time, or someone moved it; no position has leapt."""
    v = np.full(N, 0.5)
    rest = State(np.full(N, -0.8), np.zeros(N))
    moved = [State(rest.q + 1.5 * k / 300, 1e3 * v) for k in range(1, 301)]
    check = make_check()
    assert not any(looks(check, [rest] * 600))
    stands = State(moved[-1].q, np.zeros(N))
    later = round((STUCK + 1.0) / H)
    wrong = looks(check, moved + [stands] * later, 5.0 + H * np.arange(600, 900 + later))
    believed = wrong.index("")
    assert not any(wrong[believed:]) and STUCK <= H * (believed - 300) < STUCK + 0.1


def test_a_joint_that_stood_is_moved_by_the_stop_of_the_others():
    """It is believed where it is after that, without the 10 s of an arm that is far away."""
    stops = State(np.zeros(N), np.r_[0.0, np.full(N - 1, 1.0)])
    way = np.linspace(0.0, 0.3, 300)
    moving = [State(stops.q + H * k * stops.v, stops.v) for k in range(-100, 1)]
    # All report zeros, as the first joint is moved by 0.1 rad and the others by 0.3 rad.
    zero = State(np.zeros(N) + 0.5, np.zeros(N))
    stands = State(np.r_[0.1, np.full(N - 1, way[-1])], np.zeros(N))
    wrong = looks(make_check(), moving + [zero] * 300 + [stands] * 300)
    assert not any(wrong[:101]) and all(wrong[101:401])
    assert wrong.index("", 401) - 401 <= round(WINDOW / H) + 2


def test_what_was_learned_from_a_lie_is_forgotten_when_it_is_told():
    """It began before sensors were known, and seemed to be their error at first."""

    def biased(state, t):
        return state._replace(v=state.v + (1.5 if t < 0.7 else 0.1 if t > 2.999 else 0.0))

    times = np.array([t for t, _ in play(make_check(), biased, 0.1, 3.6, 4.0)])
    assert 0.11 < times[0] < 0.2
    # Known again after 200 states in motion, and told by the second.
    again = times[(times > 2.0) & (times < 3.6)]
    assert again[0] == pytest.approx(3.0) and again.size == round(0.6 / H)


def test_positions_that_freeze_are_told_by_the_second_state():
    refused = play(make_check(), lambda state, t: state._replace(q=sine(1.0).q), begin=1.002)
    assert [wrong for _, wrong in refused[:2]] == [UNDECIDED, CONTRADICTION]
    assert refused[1][0] == pytest.approx(1.004)


def test_positions_that_froze_before_sensors_are_known_are_believed_when_they_go_on():
    """They are told late, and leap as they go on."""
    refused = play(make_check(), SPOILT["frozen positions"][0], 1.0, 1.6, 3.0, 0.01)
    assert refused[0][0] > 1.02 and 1.6 < refused[-1][0] < 1.6 + 2.0 * WINDOW + 0.02


def test_velocities_that_freeze_are_told_when_the_arm_is_faster_by_some_percent():
    refused = play(make_check(), lambda state, t: state._replace(v=sine(1.0).v), begin=1.002)
    change = np.abs(sine(refused[1][0]).v - sine(1.0).v)
    assert change.max() < 0.05 * 2.0


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


@pytest.mark.parametrize("speed", [0.0, 0.02, -0.02])
@pytest.mark.parametrize("b", [-2.0, 0.6])
@pytest.mark.parametrize("early", [0.5, 0.8, 0.99])
def test_a_bias_of_velocities_of_an_arm_that_hardly_moves_is_no_clock_that_was_set(
    speed, b, early
):
    """As if hardly any time had passed; and the message came that soon after one that was late."""
    check = make_check()
    rest = sine(3.0).q
    said = []
    for k in range(2000):
        t = k * H
        state = sine(t) if t < 3.0 else State(rest + speed * (t - 3.0), np.full(N, speed))
        if k >= 1900:
            state = state._replace(v=state.v + b)
        said.append(check.look(state, t, t + (early * H if k == 1899 else 0.0)))
    assert set(said[1600:1900]) == {""}
    assert said[1900:1902] == [UNDECIDED, CONTRADICTION]


def test_a_stamp_that_is_hardly_newer_blinds_for_no_lie_afterwards():
    check = make_check()
    stamps = H * np.arange(1000)
    stamps[700] = stamps[699] + 0.01 * H
    said = []
    for k, t in enumerate(stamps):
        q, v = sine(k * H)
        said.append(check.look(State(q, v + (0.6 if k >= 703 else 0.0)), t))
    assert set(said[600:700]) == {""} and set(said[700:703]) <= {"", UNDECIDED}
    assert CONTRADICTION in said[703:706]


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
