# SPDX-License-Identifier: Apache-2.0
"""Braking plans: where they end, what is left of them after a step, and how torques change."""

import numpy as np
import pinocchio as pin
import pytest

from torque_safety_controller.parts.whole_arm.braking_plan import (
    AT_REST,
    UNIFORM,
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


def random_state(rng, share=1.0):
    """A state from which no joint has to brake harder than it can within a step."""
    q = rng.uniform(LOW, HIGH)
    room = np.where(rng.random(N) < 0.5, HIGH - q, LOW - q)
    hardest = share * np.sqrt(2.0 * BRAKING * np.abs(room))
    return q, np.sign(room) * rng.uniform(0.0, 1.0, N) * np.minimum(hardest, 2.0)


@pytest.mark.parametrize("seed", range(8))
def test_samples_are_states_of_the_plan(seed):
    rng = np.random.default_rng(seed)
    q, v = random_state(rng)
    periods = periods_of(q, v, rng.uniform(DT, 1.0))
    clock, positions, velocities, accelerations, _ = sampled(q, v, periods)
    states = played(q, v, periods)
    assert (clock[:UNIFORM] == periods.max() * np.arange(UNIFORM) / UNIFORM).all()
    assert {*periods, *(periods - 1.0)} <= {*clock}
    for k, time in enumerate(clock):
        now = states[int(time)]
        t = DT * (time - int(time))  # within a period
        moved = np.minimum(t, np.maximum(DT * (periods - int(time)), 0.0))
        np.testing.assert_allclose(
            positions[k], now[0] + moved * (now[1] + 0.5 * moved * now[2]), atol=1e-10
        )
        np.testing.assert_allclose(velocities[k], now[1] + moved * now[2], atol=1e-10)
        np.testing.assert_allclose(accelerations[k], now[2], atol=ROUNDING)
    np.testing.assert_array_equal(velocities[AT_REST], 0.0)
    np.testing.assert_array_equal(accelerations[AT_REST], 0.0)


@pytest.mark.parametrize("seed", range(20))
def test_a_plan_ends_within_the_limits(seed):
    rng = np.random.default_rng(seed)
    q, v = random_state(rng)
    _, positions, velocities, _, beyond = sampled(q, v, periods_of(q, v, rng.uniform(DT, 1.0)))
    assert beyond == 0.0
    assert (positions >= LOW - TOLERANCE - 1e-12).all()
    assert (positions <= HIGH + TOLERANCE + 1e-12).all()
    assert (np.abs(velocities) <= np.abs(v) + 1e-12).all()


A = BRAKING[3]


@pytest.mark.parametrize(
    ("place", "speed", "T", "expected"),
    [
        (0.0, 0.1, 0.3, 30),  # the time of the plan
        (0.0, 0.1, 0.305, 31),  # rounded up
        (0.0, 1.0, 0.05, np.ceil(1.0 / A / DT)),  # no harder than A
        (1.1, 1.0, 0.3, 20),  # stands at the limit
        (1.1, -1.0, 0.3, 30),  # which is not ahead
        (-0.9, -1.0, 0.3, 20),  # the lower one
        (1.2 - 0.0595, 1.0, 0.3, 12),  # with A, though it stands 0.5 mrad beyond
        (1.2 - 0.02, 1.0, 0.3, 4),  # harder than A, as nothing else helps
        (1.2, 0.0, 0.3, 30),  # at rest at the limit
        (1.3, 0.0, 0.3, 30),  # and beyond
        (1.3, 0.1, 0.3, 1),  # at once
    ],
)
def test_what_decides_how_long_a_joint_takes(place, speed, T, expected):
    assert A == 9.0
    q, v = np.zeros(N), np.zeros(N)
    q[3], v[3] = place, speed
    assert periods_of(q, v, T)[3] == expected


@pytest.mark.parametrize(
    ("place", "speed", "beyond"),
    [
        (1.2, 0.1, 0.0),
        (1.2, 1.0, 0.5 * 1.0 * DT - 1e-3),
        (1.21, 0.0, 0.01 - 1e-3),
        (-1.02, -0.5, 0.02 + 0.5 * 0.5 * DT - 1e-3),
        (-1.02, 0.5, 0.02 - 1e-3),
    ],
)
def test_a_limit_that_cannot_be_kept_is_told(place, speed, beyond):
    q, v = np.zeros(N), np.zeros(N)
    q[3], v[3] = place, speed
    assert sampled(q, v, periods_of(q, v, 0.3))[-1] == pytest.approx(beyond)


@pytest.mark.parametrize("seed", range(8))
def test_the_rest_of_a_plan_is_a_plan(seed):
    """What makes one plan, once found, enough for ever: period by period until it stands."""
    rng = np.random.default_rng(seed)
    q, v = random_state(rng)
    periods = periods_of(q, v, rng.uniform(3.0 * DT, 0.8))
    states, beyond = played(q, v, periods), sampled(q, v, periods)[-1]
    for k in range(1, len(states)):
        rest = np.maximum(periods - k, 1.0)
        left = sampled(*states[k][:2], rest)
        assert left[-1] <= beyond + 1e-12
        for mine, other in zip(left[1:4], states[k], strict=True):
            np.testing.assert_allclose(mine[0], other, atol=1e-8)


def passes(place, speed, A, limit):
    """Whether a joint passes an upper limit though it stops in whole periods with at most A."""
    needed = np.ceil(max(speed, 0.0) / (A * DT) - ROUNDING)
    return max(place, place + 0.5 * DT * speed * needed) > limit + ROUNDING


@pytest.mark.parametrize("seed", range(10))
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


def test_the_plan_is_within_the_bounds_and_from_outside_only_the_way_back_is():
    q, v, plan = HIGH + 0.1, np.full(N, 0.5), np.full(N, -20.0)
    low, high = narrow(q, v, plan, -BRAKING, BRAKING, LOW, HIGH, BRAKING, DT)
    np.testing.assert_array_equal(high, plan)
    np.testing.assert_array_equal(low, plan)
    low, high = narrow(HIGH, v, plan, -BRAKING, BRAKING, LOW, HIGH, BRAKING, DT)
    assert (low <= high).all()
    np.testing.assert_array_less(high, 0.0)


def test_joints_without_limits_are_free():
    free, v = np.full(N, np.inf), np.full(N, 0.5)
    low, high = narrow(np.zeros(N), v, 0.0 * v, -BRAKING, BRAKING, -free, free, BRAKING, DT)
    np.testing.assert_array_equal(low, -BRAKING)
    np.testing.assert_array_equal(high, BRAKING)
    periods = braking_periods(np.zeros(N), v, np.array([0.3]), -free, free, *LIMITS[2:])
    assert (periods >= 30).all()


def sample_model():
    """A manipulator of seven joints."""
    model = pin.buildSampleModelManipulator()
    joint = model.addJoint(model.njoints - 1, pin.JointModelRX(), pin.SE3.Random(), "more")
    model.appendBodyToJoint(joint, pin.Inertia.Random(), pin.SE3.Identity())
    assert model.nv == N
    return model


@pytest.mark.parametrize("seed", range(4))
def test_torques_of_plans_are_those_of_inverse_dynamics_with_what_is_given_besides(seed):
    rng, model = np.random.default_rng(seed), sample_model()
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


@pytest.mark.parametrize("seed", range(4))
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
            da = np.zeros(N)
            da[j] = step
            high, low = (torque(begin + s * da, clock - 1) for s in (1.0, -1.0))
            measured = (high - low) / (2.0 * step)
            scale = max(np.abs(measured).max(), 1e-6)
            np.testing.assert_allclose(change[:, j], measured, atol=1e-4 * scale)
