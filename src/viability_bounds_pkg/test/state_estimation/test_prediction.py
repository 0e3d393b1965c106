# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pinocchio as pin
import pytest
from true_arm import TrueArm, model

from viability_bounds_pkg.state import State
from viability_bounds_pkg.state_estimation.estimator import StateEstimator
from viability_bounds_pkg.state_estimation.observer import design_observer
from viability_bounds_pkg.state_estimation.prediction import CommandsUnderWay, MotorLag

PERIOD_NS = 2_000_000
DT = 1e-9 * PERIOD_NS
N = 7
MAX = np.full(N, 87.0)
FAST = np.full(N, 2.0)
STILL = np.array([0.1, -0.6, 0.2, -1.9, 0.3, 1.2, 0.4])


def estimator(delay=0, dt=DT, lag=0.0, observers=None, longest_gap=1, lasting=0.0):
    lags, learned = np.full(N, lag), np.full(N, lasting)
    return StateEstimator(model(), dt, delay, lags, observers, FAST, MAX, learned, longest_gap)


def gravity(state):
    return np.array(pin.nonLinearEffects(model(), model().createData(), *state))


def some_torques(rng, state, count):
    """Return torques around those that hold the arm."""
    return gravity(state) + rng.uniform(-1.0, 1.0, (count, N)) * [20, 20, 15, 15, 2, 2, 1]


# The commands under way


def test_commands_are_those_that_act_between_the_state_and_its_answer():
    way = CommandsUnderWay(2)
    for stamp in range(1, 8):
        way.add_state(stamp)
        way.answer(stamp, np.full(2, float(stamp)))
    way.add_state(8)
    # State 8 is of the instant 8 - sensing; command 8 acts 2 periods later: 6 and 7 until then.
    assert [tau[0] for tau in way.acting()] == [5.0, 6.0, 7.0]


def test_without_delay_only_the_command_that_acted_last():
    way = CommandsUnderWay(0)
    way.add_state(1)
    way.answer(1, np.ones(2))
    way.add_state(2)
    (tau,) = way.acting()
    assert tau[0] == 1.0


def test_a_command_that_never_came_holds_the_last():
    way = CommandsUnderWay(2)
    for stamp in (1, 2, 3, 4, 5):
        way.add_state(stamp)
        if stamp in (1, 4):
            way.answer(stamp, np.full(2, float(stamp)))
    assert [tau[0] for tau in way.acting()] == [1.0, 1.0, 4.0]
    for stamp in (6, 7, 8):
        assert not way.silent
        way.add_state(stamp)
    assert way.silent
    assert [tau[0] for tau in way.acting()] == [4.0, 4.0, 4.0]


def test_of_several_commands_for_a_state_the_first_acts_and_those_for_no_state_do_not():
    way = CommandsUnderWay(1)
    way.add_state(1)
    way.answer(1, np.ones(2))
    way.answer(1, np.full(2, 7.0))
    way.answer(9, np.full(2, 8.0))
    way.add_state(2)
    way.answer(2, np.full(2, 2.0))
    way.add_state(3)
    assert [tau[0] for tau in way.acting()] == [1.0, 2.0]


def test_lost_states_have_no_commands():
    way = CommandsUnderWay(2)
    way.add_state(1)
    way.answer(1, np.ones(2))
    way.add_state(4, periods=3)
    assert [tau[0] for tau in way.acting()] == [1.0, 1.0, 1.0]
    way.answer(4, np.full(2, 4.0))
    way.add_state(5)
    assert [tau[0] for tau in way.acting()] == [1.0, 1.0, 4.0]


def test_position_commands_have_no_torque():
    way = CommandsUnderWay(1)
    for stamp, tau in ((1, np.ones(2)), (2, None)):
        way.add_state(stamp)
        way.answer(stamp, tau)
    way.add_state(3)
    first, second = way.acting()
    assert first[0] == 1.0
    assert second is None


def test_before_the_first_command_none_acts():
    way = CommandsUnderWay(1)
    way.add_state(1)
    assert way.acting() == [None, None]


# The motors' lag


def test_torque_of_the_motors_follows_the_command_exactly():
    lag, dt = np.array([0.0, 1e-4, 0.002, 0.5]), 0.001
    motors = MotorLag(lag, dt)
    before, command = np.array([1.0, 2.0, -3.0, 4.0]), np.array([5.0, -1.0, 2.0, 0.0])
    t = (np.arange(100_000) + 0.5) / 100_000 * dt
    slow = lag[1:, None]
    path = command[1:, None] + np.exp(-t / slow) * (before - command)[1:, None]
    after = motors.end(before, command)
    assert after[0] == 5.0
    np.testing.assert_allclose(after[1:], path[:, -1], rtol=1e-3)
    mean = motors.mean(before, after)
    assert mean[0] == 5.0
    np.testing.assert_allclose(mean[1:], path.mean(axis=1), rtol=1e-7)


@pytest.mark.parametrize("lag", [2e-4, 1.6e-3, 0.02])
def test_with_its_lead_a_lagging_double_integrator_is_one_that_the_commands_drive(lag):
    dt = 0.002
    rng = np.random.default_rng(1)
    lags = np.full(1, lag)
    motors = MotorLag(lags, dt)
    q, v, a = 0.2, -0.4, 3.0
    ours = motors.lead(State(np.array([q]), np.array([v])), np.array([a]))
    for command in rng.uniform(-10.0, 10.0, 50):
        # Exact integral of a' = (command - a) / lag.
        gap, decay = a - command, math.exp(-dt / lag)
        q += v * dt + 0.5 * command * dt**2 + gap * lag * (dt - lag * (1.0 - decay))
        v += command * dt + gap * lag * (1.0 - decay)
        a = command + gap * decay
        ours = ours.after(np.array([command]), dt)
        np.testing.assert_allclose(
            motors.lead(State(np.array([q]), np.array([v])), np.array([a])), ours, atol=1e-12
        )


# The state in which a command acts


def run(dt, delay, lag, rng, observers=None, steps=40):
    """Return how far the prediction is off for an arm that takes random torques."""
    period = round(1e9 * dt)
    start = State(STILL, np.array([0.3, -0.4, 0.5, 0.3, -0.6, 0.5, 0.7]))
    # Torques that change as quickly in time whatever the period is.
    times = np.linspace(0.0, 0.2, 11)
    table = some_torques(rng, start, 11)
    command = lambda k: np.array([np.interp(k * dt, times, row) for row in table.T])  # noqa: E731
    lags = None if lag == 0.0 else np.full(N, lag)
    arm = TrueArm(model(), dt, start, command(0), lags)
    ours = estimator(delay, dt, lag, observers)
    predicted, states = [], []
    for k in range(1, steps + delay + 2):
        states.append((arm.state, arm.acceleration()))
        predicted.append(ours.step(k * period, arm.state, arm.tau))
        # The command that answers it acts `delay` periods later.
        ours.answer(k * period, command(k))
        arm.step(command(max(k - delay, 0)))
    errors = []
    for k in range(delay + 2, steps):
        truth, a = states[k + delay]
        truth = State(truth.q + lag * truth.v, truth.v + lag * a)
        errors.append([np.abs(x - y).max() for x, y in zip(truth, predicted[k], strict=True)])
    return np.max(errors, axis=0)


@pytest.mark.parametrize("lag", [0.0, 0.0016])
@pytest.mark.parametrize("delay", [0, 1, 2, 5])
def test_prediction_is_that_of_an_independent_integration(delay, lag):
    q, v = run(DT, delay, lag, np.random.default_rng(3))
    # Within a period of 2 ms torques with a lag change, which the position feels.
    assert q <= (1e-6 if lag == 0.0 else 1e-5) * (1 + delay)
    assert v <= 5e-4 * (1 + delay)


@pytest.mark.parametrize("lag", [0.0, 0.0016])
def test_prediction_is_of_second_order(lag):
    q, v = zip(
        *(run(dt, 2, lag, np.random.default_rng(3), steps=30) for dt in (0.004, 0.002, 0.001)),
        strict=True,
    )
    for coarse, fine in ((0, 1), (1, 2)):
        assert v[fine] < 0.3 * v[coarse]
        assert q[fine] < 0.3 * q[coarse]


def test_states_pass_unchanged_where_nothing_is_declared():
    rng = np.random.default_rng(5)
    ours = estimator()
    for k in range(1, 20):
        reported = State(rng.uniform(-1, 1, N), rng.uniform(-1, 1, N))
        answer = ours.step(k * PERIOD_NS, reported, rng.uniform(-9, 9, N) if k % 2 else None)
        ours.answer(k * PERIOD_NS, rng.uniform(-9, 9, N))
        np.testing.assert_array_equal(answer, reported)
    assert not ours.resets


def test_an_exact_robot_is_estimated_exactly():
    q, v = run(DT, 0, 0.0, np.random.default_rng(3), design_observer(DT, np.zeros(N), np.zeros(N)))
    assert q <= 1e-12
    assert v <= 2e-4


# Which torque acted


def moving(delay=0, observers=None):
    """Return an estimator at a state, commands held for some periods, and the next stamp."""
    ours = estimator(delay, observers=observers)
    tau = gravity(State(STILL, np.zeros(N)))
    for k in range(1, 6):
        ours.step(k * PERIOD_NS, State(STILL, np.zeros(N)), tau)
        ours.answer(k * PERIOD_NS, tau)
    return ours, tau, 6


PUSH = np.array([10.0, 0, 0, 0, 0, 0, 0])
OBSERVERS = design_observer(DT, np.full(N, 1e-4), np.full(N, 5.0))


def speed_after(command, effort):
    """Return the speed of joint 1 that is estimated after a command and a reported effort."""
    ours, tau, k = moving(observers=OBSERVERS)
    still = State(STILL, np.zeros(N))
    ours.step(k * PERIOD_NS, still, tau)
    ours.answer(k * PERIOD_NS, tau + command)
    answer = ours.step((k + 1) * PERIOD_NS, still, None if effort is None else tau + effort)
    return answer.v[0]


def test_the_command_is_believed_where_the_effort_agrees_or_is_missing():
    pushed = speed_after(PUSH, PUSH)
    assert pushed > 0.01
    assert speed_after(PUSH, None) == pushed
    assert speed_after(PUSH, PUSH + 1.0) == pushed


def test_a_command_that_the_effort_disproves_did_not_come():
    assert speed_after(PUSH, 0.0 * PUSH) == pytest.approx(0.0, abs=1e-9)
    assert speed_after(PUSH, 0.2 * PUSH) == pytest.approx(0.0, abs=1e-9)


def test_the_effort_is_believed_where_no_command_explains_it():
    assert speed_after(0.0 * PUSH, 2.0 * PUSH) == speed_after(2.0 * PUSH, 2.0 * PUSH)


def test_where_efforts_cease_the_last_one_has_no_effect_on_what_is_predicted():
    ours, tau, k = moving(delay=2, observers=OBSERVERS)
    still = State(STILL, np.zeros(N))
    for more in range(50):
        answer = ours.step((k + more) * PERIOD_NS, still, tau + PUSH if more < 3 else None)
        ours.answer((k + more) * PERIOD_NS, tau)
        if more == 2:
            assert answer.v[0] > 0.01
    assert np.abs(answer.v).max() < 1e-6


@pytest.mark.parametrize(("quiet", "believed"), [(2, False), (300, True)])
def test_the_quieter_the_effort_the_less_it_must_differ_to_be_believed(quiet, believed):
    ours, tau, k = moving(observers=OBSERVERS)
    still = State(STILL, np.zeros(N))
    for stamp in range(k, k + quiet):
        ours.step(stamp * PERIOD_NS, still, tau)
        ours.answer(stamp * PERIOD_NS, tau)
    answer = ours.step((k + quiet) * PERIOD_NS, still, tau + 0.5 * PUSH)  # 6 % of torque_max
    assert (answer.v[0] > 1e-3) == believed


def test_drives_that_control_positions_hold_the_torque_that_they_report():
    ours, tau, k = moving(delay=3)
    still = State(STILL, np.zeros(N))
    for stamp in range(k, k + 5):
        answer = ours.step(stamp * PERIOD_NS, still, tau + PUSH)
        ours.answer(stamp * PERIOD_NS, None)
    arm = TrueArm(model(), DT, still, tau)
    for _ in range(3):
        arm.step(tau + PUSH)
    np.testing.assert_allclose(answer, arm.state, atol=1e-4)
    assert answer.v[0] > 0.1


def test_brakes_that_no_effort_tells_of_hold_before_the_first_command():
    ours = estimator(delay=2, observers=OBSERVERS)
    for k in range(1, 9):
        answer = ours.step(k * PERIOD_NS, State(STILL, np.zeros(N)), np.zeros(N))
    np.testing.assert_allclose(answer, State(STILL, np.zeros(N)), atol=1e-9)
    # A command on its way: the brakes hold until it acts.
    ours.answer(k * PERIOD_NS, gravity(State(STILL, np.zeros(N))))
    answer = ours.step((k + 1) * PERIOD_NS, State(STILL, np.zeros(N)), np.zeros(N))
    np.testing.assert_allclose(answer, State(STILL, np.zeros(N)), atol=1e-9)


@pytest.mark.parametrize("lag", [0.0, 0.0016])
@pytest.mark.parametrize("stood", [1, 200])
def test_an_arm_that_friction_holds_does_not_move_as_commands_take_effect_little_by_little(
    lag, stood
):
    ours = estimator(delay=2, lag=lag, observers=OBSERVERS, lasting=200.0)
    still = State(STILL, np.zeros(N))
    command = gravity(still)
    stopped = command + [12.0, -15.0, 9.0, 12.0, 2.0, -1.0, 0.1]  # as the robot stopped itself
    for k in range(1, stood + 150):
        share = max(0.0, 1.0 - max(0, k - stood) / 100.0)
        answer = ours.step(k * PERIOD_NS, still, command + share * (stopped - command))
        # More than twice as much where commands are taken to act at once.
        assert np.abs(answer.v).max() < 0.09, k
        if k > stood:
            ours.answer(k * PERIOD_NS, command)
    # From then on commands that are sent act.
    for more in range(4):
        ours.answer((k + more) * PERIOD_NS, command + PUSH)
        answer = ours.step((k + more + 1) * PERIOD_NS, still, command + PUSH * (more > 1))
    assert answer.v[0] > 0.02


def test_without_torques_velocities_are_taken_to_stay():
    ours = estimator(delay=2, observers=OBSERVERS)
    v = np.full(N, 0.3)
    for k in range(1, 9):
        answer = ours.step(k * PERIOD_NS, State(STILL + k * DT * v, v), None)
    np.testing.assert_allclose(answer, State(STILL + 10 * DT * v, v), atol=2e-4)


# Starting anew


def reset_case(stamp, state):
    ours, tau, k = moving(delay=1, observers=OBSERVERS)
    answer = ours.step(round(stamp(k) * PERIOD_NS), state, tau)
    return ours, answer


def test_it_starts_anew_after_a_gap_in_the_stamps():
    ours, answer = reset_case(lambda k: k + 3, State(STILL + 1e-3, np.zeros(N)))
    assert dict(ours.resets) == {"stamps jumped": 1}
    np.testing.assert_allclose(answer.q, STILL + 1e-3, atol=1e-4)


def test_it_starts_anew_with_a_robot_that_starts_over():
    ours, _ = reset_case(lambda k: 1, State(STILL, np.zeros(N)))
    assert dict(ours.resets) == {"stamps jumped": 1}


def test_it_starts_anew_where_the_state_jumps():
    elsewhere = State(STILL + [0, 0, 0, 0.01, 0, 0, 0], np.full(N, 0.2))
    ours, answer = reset_case(lambda k: k, elsewhere)
    assert dict(ours.resets) == {"the state jumped": 1}
    np.testing.assert_allclose(answer.v, elsewhere.v, atol=0.15)
    assert (ours.innovation <= OBSERVERS.innovation).all()


def test_stamps_that_are_not_quite_regular_are_the_next_ones():
    ours, _ = reset_case(lambda k: k - 0.4, State(STILL, np.zeros(N)))
    assert not ours.resets


def test_a_gap_as_long_as_declared_is_bridged():
    v = np.full(N, 0.4)
    ours = estimator(0, DT, 0.0, OBSERVERS, longest_gap=3)
    for k in (1, 2, 3, 4, 7, 8):
        answer = ours.step(k * PERIOD_NS, State(STILL + k * DT * v, v), None)
    assert not ours.resets
    np.testing.assert_allclose(answer, State(STILL + 8 * DT * v, v), atol=1e-3)


def test_no_number_that_is_not_finite_comes_out():
    ours, tau, k = moving(delay=2)
    for stamp in range(k, k + 4):
        reported = State(STILL, np.full(N, 1e200))
        answer = ours.step(stamp * PERIOD_NS, reported, tau)
        assert np.isfinite(answer).all()
        ours.answer(stamp * PERIOD_NS, tau)
    assert ours.resets["the model diverged"]
