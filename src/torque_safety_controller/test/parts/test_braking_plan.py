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
NONE = np.zeros(N), np.full(N, np.inf)
LIMITS = PlanLimits(LOW, HIGH, np.full(N, 1e-3), BRAKING, DT, *NONE)
CURVED = LIMITS._replace(velocity_offset=np.full(N, 0.3), deceleration_limit=0.8 * BRAKING)


def sampled(q, v, periods, limits=LIMITS):
    """States of a plan at its samples, and by how far it passes limits."""
    _, *states, beyond = sample(q, v, periods[np.newaxis], limits)
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
    periods = braking_periods(q, v, np.array([0.2 * (seed + 1)]), LIMITS)[0]
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


@pytest.mark.parametrize("seed", range(4))
def test_plans_keep_speed_limits_that_depend_on_position(seed):
    """Against the definition at many instants; one of an upper limit, and its mirror image."""
    c, d = CURVED.velocity_offset, CURVED.deceleration_limit
    rng = np.random.default_rng(seed)
    q = rng.uniform(0.2, 1.1, N)
    v = rng.uniform(0.1, 1.0, N) * (np.sqrt(2.0 * d * (HIGH - q)) - c)

    def too_near(periods):
        """By how much less than the speed needs the distance to the limit is, at most."""
        t = np.linspace(0.0, 1.0, 2000)[:, None] * periods * DT
        speed = v * (1.0 - t / (periods * DT))
        room = HIGH - (q + 0.5 * t * (v + speed))
        return np.max((speed + c) ** 2 / (2.0 * d) - room - CURVED.tolerance, axis=0)

    longest = braking_periods(q, v, np.array([9.0]), CURVED)[0]
    hardest = np.ceil(v / (BRAKING * DT))
    assert (too_near(longest) <= 1e-9).all()
    chosen = longest > hardest  # the others only just stop in time
    assert chosen.any() and (too_near(longest + 1.0) > -CURVED.tolerance)[chosen].all()
    for periods in (longest, longest + 1.0, 2.0 * longest):
        expected = max(0.0, too_near(periods).max())
        assert sampled(q, v, periods, CURVED)[1] == pytest.approx(expected, abs=1e-6)
        mirrored = CURVED._replace(q_min=-HIGH, q_max=-LOW)
        assert sampled(-q, -v, periods, mirrored)[1] == pytest.approx(expected, abs=1e-6)


def passes(place, speed, A, limit):
    """Whether a joint passes an upper limit though it stops in whole periods with at most A."""
    needed = np.ceil(max(speed, 0.0) / (A * DT) - 1e-9)
    return max(place, place + 0.5 * DT * speed * needed) > limit + 1e-9


@pytest.mark.parametrize("seed", range(4))
def test_bounds_are_narrowed_to_the_last_acceleration_from_which_a_joint_can_stop(seed):
    """Against the definition: at each end, and just outside."""
    q, v = random_state(seed)
    free, far = np.full(N, np.inf), np.full(N, 1e4)
    _, highest = narrow(q, v, -far, -free, free, LIMITS)
    lowest, _ = narrow(q, v, far, -free, free, LIMITS)
    for sign, ends, limit in ((1.0, highest, HIGH), (-1.0, -lowest, -LOW)):
        for j in range(N):
            for a, expected in ((ends[j], False), (ends[j] + 1e-3, True)):
                speed = sign * v[j] + DT * a
                place = sign * q[j] + 0.5 * DT * (sign * v[j] + speed)
                assert passes(place, speed, BRAKING[j], limit[j]) == expected
