# SPDX-License-Identifier: Apache-2.0
"""Braking plans: where they end, what is left of them after a step, and how torques change."""

import numpy as np
import pinocchio as pin
import pytest

from torque_safety_controller.parts.whole_arm.braking_plan import (
    PlanLimits,
    PlanTorques,
    braking_periods,
    narrow,
    sample,
    torque_change,
)

DT = 0.01
N = 7
LOW, HIGH = np.full(N, -1.0), np.full(N, 1.2)
BRAKING = np.linspace(3.0, 15.0, N)
TOLERANCE = np.full(N, 1e-3)
LIMITS = PlanLimits(LOW, HIGH, TOLERANCE, BRAKING, DT)
ROUNDING = 1e-9


def periods_of(q, v, T):
    return braking_periods(q, v, np.array([T]), *LIMITS)[0]


def sampled(q, v, periods):
    """Clock, states of one plan, and by how far it passes limits."""
    *states, beyond = sample(q, v, periods[np.newaxis], LOW, HIGH, TOLERANCE, DT)
    return (*(each[0] for each in states), beyond[0])


def played(q, v, periods):
    """States and accelerations at the beginning of each period until all joints stand."""
    v0, states = v, []
    for k in range(int(periods.max()) + 2):
        a = np.where(k < periods, -v0 / (DT * periods), 0.0)
        states.append((q, v, a))
        q, v = q + DT * v + 0.5 * DT * DT * a, v + DT * a
    return states


def random_state(rng):
    """A state from which no joint has to brake harder than it can within a step."""
    q = rng.uniform(LOW, HIGH)
    room = np.where(rng.random(N) < 0.5, HIGH - q, LOW - q)
    hardest = np.sqrt(2.0 * BRAKING * np.abs(room))
    return q, np.sign(room) * rng.uniform(0.0, 1.0, N) * np.minimum(hardest, 2.0)


@pytest.mark.parametrize("seed", range(4))
def test_a_plan_ends_within_the_limits_and_its_samples_are_its_states(seed):
    rng = np.random.default_rng(seed)
    q, v = random_state(rng)
    periods = periods_of(q, v, rng.uniform(DT, 1.0))
    clock, positions, velocities, accelerations, beyond = sampled(q, v, periods)
    states = played(q, v, periods)
    assert {*periods, *(periods - 1.0)} <= {*clock}
    for k, time in enumerate(clock):
        q_now, v_now, a_now = states[int(time)]
        t = DT * (time - int(time))  # within a period
        moved = np.minimum(t, np.maximum(DT * (periods - int(time)), 0.0))
        place = q_now + moved * (v_now + 0.5 * moved * a_now)
        np.testing.assert_allclose(positions[k], place, atol=1e-10)
        np.testing.assert_allclose(velocities[k], v_now + moved * a_now, atol=1e-10)
        np.testing.assert_allclose(accelerations[k], a_now, atol=ROUNDING)
    assert not velocities[-1].any()
    assert beyond == 0.0
    assert (positions >= LOW - TOLERANCE - 1e-12).all()
    assert (positions <= HIGH + TOLERANCE + 1e-12).all()
    assert (np.abs(velocities) <= np.abs(v) + 1e-12).all()


@pytest.mark.parametrize(
    ("place", "speed", "expected", "beyond"),
    [
        (0.0, 0.1, 30, 0.0),  # the time that is asked for
        (1.1, 1.0, 20, 0.0),  # stands at the limit
        (1.1, -1.0, 30, 0.0),  # which is not ahead
        (1.2 - 0.02, 1.0, 4, 0.0),  # harder than usual, as nothing else helps
        (1.3, 0.1, 1, 0.1 + 0.5 * 0.1 * DT - 1e-3),  # beyond: at once
        (-1.02, 0.5, 30, 0.02 - 1e-3),  # on its way back
    ],
)
def test_how_long_a_joint_takes_and_by_how_far_it_passes_its_limit(place, speed, expected, beyond):
    q, v = np.zeros(N), np.zeros(N)
    q[3], v[3] = place, speed
    periods = periods_of(q, v, 0.3)
    assert periods[3] == expected
    assert sampled(q, v, periods)[-1] == pytest.approx(beyond)


@pytest.mark.parametrize("seed", range(4))
def test_the_rest_of_a_plan_is_a_plan(seed):
    """What makes one plan, once found, enough for ever: period by period until it stands."""
    rng = np.random.default_rng(seed)
    q, v = random_state(rng)
    periods = periods_of(q, v, rng.uniform(3.0 * DT, 0.8))
    states, beyond = played(q, v, periods), sampled(q, v, periods)[-1]
    for k in range(1, len(states)):
        left = sampled(*states[k][:2], np.maximum(periods - k, 1.0))
        assert left[-1] <= beyond + 1e-12
        for mine, other in zip(left[1:4], states[k], strict=True):
            np.testing.assert_allclose(mine[0], other, atol=1e-8)


def passes(place, speed, A, limit):
    """Whether a joint passes an upper limit though it stops in whole periods with at most A."""
    needed = np.ceil(max(speed, 0.0) / (A * DT) - ROUNDING)
    return max(place, place + 0.5 * DT * speed * needed) > limit + ROUNDING


@pytest.mark.parametrize("seed", range(5))
def test_bounds_are_narrowed_to_the_last_acceleration_from_which_a_joint_can_stop(seed):
    """Against the definition: at each end, and just outside."""
    q, v = random_state(np.random.default_rng(seed))
    free, far = np.full(N, np.inf), np.full(N, 1e4)
    _, highest = narrow(q, v, -far, -free, free, LOW, HIGH, BRAKING, DT)
    lowest, _ = narrow(q, v, far, -free, free, LOW, HIGH, BRAKING, DT)
    for sign, ends, limit in ((1.0, highest, HIGH), (-1.0, -lowest, -LOW)):
        for j in range(N):
            for a, expected in ((ends[j], False), (ends[j] + 1e-3, True)):
                speed = sign * v[j] + DT * a
                place = sign * q[j] + 0.5 * DT * (sign * v[j] + speed)
                assert passes(place, speed, BRAKING[j], limit[j]) == expected


def sample_model():
    """A manipulator of seven joints."""
    model = pin.buildSampleModelManipulator()
    joint = model.addJoint(model.njoints - 1, pin.JointModelRX(), pin.SE3.Random(), "more")
    model.appendBodyToJoint(joint, pin.Inertia.Random(), pin.SE3.Identity())
    assert model.nv == N
    return model


def test_torques_of_plans_are_those_of_inverse_dynamics_with_what_is_given_besides():
    rng, model = np.random.default_rng(0), sample_model()
    data, usable, extra = model.createData(), rng.uniform(5.0, 50.0, N), rng.normal(size=N)
    q, v = random_state(rng)
    periods = braking_periods(q, v, np.array([0.1, 0.4]), *LIMITS)
    plans = PlanTorques(model, LIMITS, usable).evaluate(q, v, periods, extra)
    for i in range(2):
        for k in range(len(plans.samples.clock[i])):
            state = (each[i, k] for each in plans.samples[1:])
            tau = pin.rnea(model, data, *state) + extra
            np.testing.assert_allclose(plans.tau[i, k], tau, atol=1e-9)
        assert plans.slack[i] == pytest.approx(1.0 - (np.abs(plans.tau[i]) / usable).max())


@pytest.mark.parametrize("seed", range(2))
def test_torques_change_as_the_derivatives_say(seed):
    """Against the torques of plans from states a little apart, at each kind of sample."""
    rng, model = np.random.default_rng(seed), sample_model()
    data, step = model.createData(), 1e-4
    q, v = random_state(rng)
    periods = periods_of(q, v, 0.4)
    rest = np.maximum(periods - 1.0, 1.0)
    states = played(q, v, periods)
    begin = states[0][2]

    def torque(a, k):
        after = played(q + v * DT + 0.5 * DT * DT * a, v + DT * a, rest)
        return pin.rnea(model, data, *after[min(k, len(after) - 1)])

    ends = np.unique(periods)
    for clock in (1, 5, int(ends[0] + ends[-1]) // 2, int(ends[-1]) - 1, int(ends[-1]) + 1):
        by_q, by_v, M = pin.computeRNEADerivatives(model, data, *states[clock])
        M = np.triu(M) + np.triu(M, 1).T
        change = torque_change(float(clock), periods, by_q, by_v, M, DT)
        for j in np.flatnonzero(periods > 1):
            da = step * np.eye(N)[j]
            measured = (torque(begin + da, clock - 1) - torque(begin - da, clock - 1)) / (2 * step)
            scale = max(np.abs(measured).max(), 1e-6)
            np.testing.assert_allclose(change[:, j], measured, atol=1e-4 * scale)
