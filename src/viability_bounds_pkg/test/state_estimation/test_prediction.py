# SPDX-License-Identifier: Apache-2.0
"""States at the instant when a command acts, and the torques that led there."""

import numpy as np
import pinocchio as pin
import pytest
from true_arm import TrueArm, model

from viability_bounds_pkg.state import State
from viability_bounds_pkg.state_estimation.estimator import StateEstimator
from viability_bounds_pkg.state_estimation.observer import design_observer

PERIOD_NS = 2_000_000
DT = 1e-9 * PERIOD_NS
N = 7
MAX = np.array([87.0, 87, 87, 87, 12, 12, 12])
FAST = np.full(N, 2.0)
STILL = State(np.array([0.1, -0.6, 0.2, -1.9, 0.3, 1.2, 0.4]), np.zeros(N))
PUSH = np.array([10.0, 0, 0, 0, 0, 0, 0])
OBSERVERS = design_observer(DT, np.full(N, 1e-4), np.full(N, 5.0))


def estimator(delay=0, dt=DT, lag=0.0, observers=None, longest_gap=1, lasting=0.0):
    lags, learned = np.full(N, lag), np.full(N, lasting)
    return StateEstimator(model(), dt, delay, lags, observers, FAST, MAX, learned, longest_gap)


def gravity(state):
    return np.array(pin.nonLinearEffects(model(), model().createData(), *state))


# The state in which a command acts

MOVING = State(STILL.q, np.array([0.3, -0.4, 0.5, 0.3, -0.6, 0.5, 0.7]))


def errors(
    ours, dt, delay, lag=0.0, start=MOVING, steps=30, missed=(), lost=(), coarse=0.0, w=0.0
):
    """Return the largest errors of the predicted states of an arm that takes random torques.

    `missed` are states whose commands never come, and `lost` those that never come themselves.
    `coarse` is the resolution of the encoders, rad: velocities are not told then, and efforts have
    noise. `w` is the size of an acceleration that the model does not know, rad/s^2.
    """
    rng = np.random.default_rng(3)
    # Torques around those that hold the arm, that change as quickly whatever the period is.
    spread = np.array([20, 20, 15, 15, 2, 2, 1]) * (0.2 if coarse else 1.0)
    table = gravity(start) + rng.uniform(-1.0, 1.0, (11, N)) * spread
    switches = rng.choice([-w, w], (N, 400))
    sent = [table[0]] * (delay + 1)
    lags = np.full(N, lag) if lag else None
    arm = TrueArm(dt, start, sent[0], lags, lambda t: switches[:, int(t / 0.0017)])
    predicted, met = [], []
    for k in range(1, steps + delay + 1):
        met.append(arm.met())
        told, effort = arm.state, arm.tau
        if coarse:
            told = State(coarse * np.rint(told.q / coarse), np.zeros(N))
            if k > 10:  # at first the effort alone tells the torque
                effort = effort + 0.01 * MAX * np.clip(rng.standard_normal(N), -3, 3)
        stamp = round(1e9 * k * dt)
        predicted.append(None if k in lost else ours.step(stamp, told, effort))
        command = np.array([np.interp(k * dt, np.linspace(0.0, 0.2, 11), row) for row in table.T])
        if k in missed or k in lost:
            command = sent[-1]  # the robot keeps the last one
        else:
            ours.answer(stamp, command)
            ours.answer(stamp, 0.0 * command)  # of several the first counts
            ours.answer(stamp + 1, 0.0 * command)  # for no state
        sent = [*sent[1:], command]
        arm.step(sent[0])
    pairs = list(zip(predicted, met[delay:], strict=False))[delay + 2 :]
    return np.max([np.abs(np.subtract(x, y)) for x, y in pairs if x is not None], axis=0)


@pytest.mark.parametrize(("delay", "lag"), [(0, 0.0), (2, 0.0), (2, 0.0016), (5, 0.0016)])
def test_prediction_is_that_of_an_independent_integration(delay, lag):
    q, v = errors(estimator(delay, DT, lag), DT, delay, lag)
    # Within a period of 2 ms torques with a lag change, which the position feels.
    assert q.max() <= (1e-6 if lag == 0.0 else 1e-5) * (1 + delay)
    assert v.max() <= 5e-4 * (1 + delay)


@pytest.mark.parametrize("without", ["missed", "lost"])
def test_prediction_knows_that_without_a_command_the_last_one_acts(without):
    q, v = errors(estimator(2, longest_gap=4), DT, 2, **{without: {10, 11, 12, 20}})
    assert q.max() <= 3e-6
    assert v.max() <= 15e-4


def test_prediction_is_of_second_order():
    coarse, fine = (
        errors(estimator(2, dt, 0.0016), dt, 2, 0.0016).max(axis=1) for dt in (0.004, 0.002)
    )
    assert (fine < 0.3 * coarse).all()


def test_an_exact_robot_is_estimated_exactly():
    exact = design_observer(DT, np.zeros(N), np.zeros(N))
    q, v = errors(estimator(observers=exact), DT, 0)
    assert q.max() <= 1e-12
    assert v.max() <= 2e-4


@pytest.mark.parametrize(("delay", "lag"), [(2, 0.0), (2, 0.0016)])
def test_errors_are_within_what_is_declared_and_hardly_less(delay, lag):
    """With coarse encoders, noise and a disturbance; the formulas are in docs/theory/bounds.md."""
    dt, resolution, w = 0.001, 1e-4, 4.0
    design = design_observer(dt, np.full(N, 0.5 * resolution), np.full(N, w))
    ours = estimator(delay, dt, lag, design)
    # 0.95: the model at the estimated state is not quite that at the true one.
    q, v = errors(ours, dt, delay, lag, STILL, 200, coarse=resolution, w=0.95 * w)
    tau = delay * dt + lag
    allowed = design.velocity_error + w * tau
    assert (q <= design.position_error + tau * design.velocity_error + 0.5 * w * tau**2).all()
    assert (v <= allowed).all()
    assert (v > 0.2 * allowed).any()
    assert not ours.resets
    assert (ours.innovation <= design.innovation).all()


def test_states_pass_unchanged_where_nothing_is_declared():
    rng, ours = np.random.default_rng(5), estimator()
    for k in range(1, 20):
        reported = State(rng.uniform(-1, 1, N), rng.uniform(-1, 1, N))
        answer = ours.step(k * PERIOD_NS, reported, rng.uniform(-9, 9, N) if k % 2 else None)
        ours.answer(k * PERIOD_NS, rng.uniform(-9, 9, N))
        np.testing.assert_array_equal(answer, reported)
    assert not ours.resets


# Which torque acted


def standing(delay=0, observers=OBSERVERS):
    """Return an estimator of an arm that commands hold, their torque, and the next period."""
    ours, tau = estimator(delay, observers=observers), gravity(STILL)
    for k in range(1, 6):
        ours.step(k * PERIOD_NS, STILL, tau)
        ours.answer(k * PERIOD_NS, tau)
    return ours, tau, 6


@pytest.mark.parametrize(
    ("command", "effort", "believed"),
    [
        (1.0, 1.0, 1.0),
        (1.0, None, 1.0),  # nothing is reported
        (1.0, 1.1, 1.0),  # noise
        (1.0, 0.0, 0.0),  # it did not come
        (1.0, 0.2, 0.0),
        (0.0, 2.0, 2.0),  # no command explains it
    ],
)
def test_the_torque_believed_is_the_command_unless_the_effort_disproves_it(
    command, effort, believed
):
    def speed(command, effort):
        ours, tau, k = standing()
        ours.step(k * PERIOD_NS, STILL, tau)
        ours.answer(k * PERIOD_NS, tau + command * PUSH)
        told = None if effort is None else tau + effort * PUSH
        return ours.step((k + 1) * PERIOD_NS, STILL, told).v[0]

    assert speed(command, effort) == pytest.approx(speed(believed, believed), abs=1e-9)
    assert speed(1.0, 1.0) > 0.01


def test_where_no_command_is_sent_the_effort_tells_what_the_robot_does():
    ours, tau, k = standing(delay=2)
    for more in range(10):
        answer = ours.step((k + more) * PERIOD_NS, STILL, tau + 0.2 * PUSH)
    assert answer.v[0] > 1e-3


def test_drives_that_control_positions_hold_the_torque_that_they_report():
    ours, tau, k = standing(delay=3, observers=None)
    for stamp in range(k, k + 5):
        answer = ours.step(stamp * PERIOD_NS, STILL, tau + PUSH)
        ours.answer(stamp * PERIOD_NS, None)
    arm = TrueArm(DT, STILL, tau)
    for _ in range(3):
        arm.step(tau + PUSH)
    np.testing.assert_allclose(answer, arm.state, atol=1e-4)
    assert answer.v[0] > 0.1


def test_brakes_that_no_effort_tells_of_hold_until_the_first_command_acts():
    ours = estimator(delay=2, observers=OBSERVERS)
    for k in range(1, 10):
        answer = ours.step(k * PERIOD_NS, STILL, np.zeros(N))
        np.testing.assert_allclose(answer, STILL, atol=1e-9)
        if k == 8:
            ours.answer(k * PERIOD_NS, gravity(STILL))


@pytest.mark.parametrize(("lag", "stood"), [(0.0, 1), (0.0016, 200)])
def test_an_arm_that_friction_holds_does_not_move_as_commands_take_effect_little_by_little(
    lag, stood
):
    ours = estimator(delay=2, lag=lag, observers=OBSERVERS, lasting=200.0)
    command = gravity(STILL)
    stopped = command + [12.0, -15.0, 9.0, 12.0, 2.0, -1.0, 0.1]  # as the robot stopped itself
    for k in range(1, stood + 150):
        share = max(0.0, 1.0 - max(0, k - stood) / 100.0)
        answer = ours.step(k * PERIOD_NS, STILL, command + share * (stopped - command))
        # More than twice as much where commands are taken to act at once.
        assert np.abs(answer.v).max() < 0.09, k
        if k > stood:
            ours.answer(k * PERIOD_NS, command)
    # From then on commands that are sent act.
    for more in range(4):
        ours.answer((k + more) * PERIOD_NS, command + PUSH)
        answer = ours.step((k + more + 1) * PERIOD_NS, STILL, command + PUSH * (more > 1))
    assert answer.v[0] > 0.02


# Starting anew


def moved(q=0.0, v=0.0):
    return State(STILL.q + [0, 0, 0, q, 0, 0, 0], STILL.v + v)


@pytest.mark.parametrize(
    ("periods", "state", "reason"),
    [
        (3, moved(1e-3), "stamps jumped"),  # a gap
        (-5, moved(), "stamps jumped"),  # a robot that starts over
        (1, moved(0.01, 0.2), "the state jumped"),
    ],
)
def test_it_starts_anew_where_states_do_not_follow(periods, state, reason):
    ours, tau, k = standing(delay=1)
    answer = ours.step((k - 1 + periods) * PERIOD_NS, state, tau)
    assert dict(ours.resets) == {reason: 1}
    np.testing.assert_allclose(answer.q, state.q, atol=1e-3)
    np.testing.assert_allclose(answer.v, state.v, atol=0.15)


def test_stamps_that_are_not_quite_regular_are_the_next_ones():
    ours, tau, k = standing(delay=1)
    ours.step(round((k - 0.4) * PERIOD_NS), STILL, tau)
    assert not ours.resets


def test_a_gap_as_long_as_declared_is_bridged_at_the_same_velocity():
    """Without torques joints are taken to keep their velocity, also in the delay."""
    v = np.full(N, 0.4)
    ours = estimator(2, observers=OBSERVERS, longest_gap=3)
    for k in (1, 2, 3, 4, 7, 8):
        answer = ours.step(k * PERIOD_NS, State(STILL.q + k * DT * v, v), None)
    assert not ours.resets
    np.testing.assert_allclose(answer, State(STILL.q + 10 * DT * v, v), atol=1e-3)


def test_no_number_that_is_not_finite_comes_out():
    ours, tau, k = standing(delay=2, observers=None)
    for stamp in range(k, k + 4):
        answer = ours.step(stamp * PERIOD_NS, State(STILL.q, np.full(N, 1e200)), tau)
        assert np.isfinite(answer).all()
        ours.answer(stamp * PERIOD_NS, tau)
    assert ours.resets["the model diverged"]
