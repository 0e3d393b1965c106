# SPDX-License-Identifier: Apache-2.0
"""Braking plans: where they end, what is left of them after a step, and how torques change."""

import numpy as np
import pytest

from torque_safety_controller.parts.whole_arm.braking_plan import (
    PlanLimits,
    braking_periods,
    narrow,
    sample,
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
