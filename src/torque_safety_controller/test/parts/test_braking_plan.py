# SPDX-License-Identifier: Apache-2.0
"""Braking plans of the safety filter: where they end, and what is left of them after a step."""

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
LIMITS = PlanLimits(LOW, HIGH, np.full(N, 1e-3), BRAKING, DT)


def sampled(q, v, periods):
    """States of a plan at its samples, and by how far it passes limits."""
    _, *states, beyond = sample(q, v, periods[np.newaxis], LOW, HIGH, LIMITS.tolerance, DT)
    return [each[0] for each in states], beyond[0]


def played(q, v, periods):
    """States and accelerations at the beginning of each period until all joints stand."""
    v0, states = v, []
    for k in range(int(periods.max()) + 2):
        a = np.where(k < periods, -v0 / (DT * periods), 0.0)
        states.append((q, v, a))
        q, v = q + DT * v + 0.5 * DT * DT * a, v + DT * a
    return states


def random_state(seed):
    """A state from which no joint has to brake harder than it can within a step."""
    rng = np.random.default_rng(seed)
    q = rng.uniform(LOW, HIGH)
    room = np.where(rng.random(N) < 0.5, HIGH - q, LOW - q)
    hardest = np.sqrt(2.0 * BRAKING * np.abs(room))
    return q, np.sign(room) * rng.uniform(0.0, 1.0, N) * np.minimum(hardest, 2.0)


@pytest.mark.parametrize("seed", range(4))
def test_a_plan_ends_within_the_limits_and_its_rest_is_a_plan(seed):
    """What makes one plan, once found, enough for ever: period by period until it stands."""
    q, v = random_state(seed)
    periods = braking_periods(q, v, np.array([0.2 * (seed + 1)]), *LIMITS)[0]
    (positions, velocities, _), beyond = sampled(q, v, periods)
    assert beyond == 0.0
    assert not velocities[-1].any()
    assert (positions >= LOW - LIMITS.tolerance - 1e-12).all()
    assert (positions <= HIGH + LIMITS.tolerance + 1e-12).all()
    for k, state in enumerate(played(q, v, periods)[1:], 1):
        rest, beyond = sampled(*state[:2], np.maximum(periods - k, 1.0))
        assert beyond <= 1e-12
        for mine, other in zip(rest, state, strict=True):
            np.testing.assert_allclose(mine[0], other, atol=1e-8)


def passes(place, speed, A, limit):
    """Whether a joint passes an upper limit though it stops in whole periods with at most A."""
    needed = np.ceil(max(speed, 0.0) / (A * DT) - 1e-9)
    return max(place, place + 0.5 * DT * speed * needed) > limit + 1e-9


@pytest.mark.parametrize("seed", range(4))
def test_bounds_are_narrowed_to_the_last_acceleration_from_which_a_joint_can_stop(seed):
    """Against the definition: at each end, and just outside."""
    q, v = random_state(seed)
    free, far = np.full(N, np.inf), np.full(N, 1e4)
    _, highest = narrow(q, v, -far, -free, free, LOW, HIGH, BRAKING, DT)
    lowest, _ = narrow(q, v, far, -free, free, LOW, HIGH, BRAKING, DT)
    for sign, ends, limit in ((1.0, highest, HIGH), (-1.0, -lowest, -LOW)):
        for j in range(N):
            for a, expected in ((ends[j], False), (ends[j] + 1e-3, True)):
                speed = sign * v[j] + DT * a
                place = sign * q[j] + 0.5 * DT * (sign * v[j] + speed)
                assert passes(place, speed, BRAKING[j], limit[j]) == expected
