# SPDX-License-Identifier: Apache-2.0
"""Braking plans: every joint slows down at a constant rate until it stands; compiled.

From a state (q, v), with one time T for the whole arm, joint j stands after

    T_j = min( max(T, |v_j| / A_j),  2 r_j / |v_j| ),

r_j the distance to its position limit in the direction of its motion: it stands at time T, later
where it would have to brake harder than A_j, sooner where it would pass the limit. Times are
whole control periods: rounded up, but for a limit rounded down. So positions and speeds keep their
limits all the way, and what is left to check are torques. The rest of a plan after a period are
the same times, one period shorter, from the state then.
"""

from __future__ import annotations

from math import ceil, floor, inf

import numpy as np
from numpy.typing import NDArray

from viability_bounds_pkg.compiled import compiled

Array = NDArray[np.float64]

UNIFORM = 20
"""Samples at equal distances in time, the first at the beginning."""

EDGE = 1e-9
"""How near a joint's stop the samples before and after it are, as a share of the longest time."""

ROUNDING = 1e-9
"""Of numbers of periods."""


def samples(n: int) -> int:
    """Return how many samples a plan of n joints has.

    Those at equal distances, one before and one after the stop of each joint, and one at rest.
    """
    return UNIFORM + 2 * n + 1


@compiled
def stop_times(
    q: Array,
    v: Array,
    T: float,
    q_min: Array,
    q_max: Array,
    tolerance: Array,
    braking: Array,
    dt: float,
    times: Array,
) -> None:
    """Fill in when each joint stands in the plan of time `T`.

    Args:
        q: positions, shape (n,), rad.
        v: velocities, shape (n,), rad/s.
        T: s.
        q_min: lowest positions at which joints are to stand, shape (n,), rad.
        q_max: highest, shape (n,), rad.
        tolerance: by how far they may stand beyond where only braking harder than A would help,
            shape (n,), rad.
        braking: A, shape (n,), rad/s^2.
        dt: control period, s.
        times: T_j, shape (n,), s; at least one period.
    """
    for j in range(q.size):
        speed = abs(v[j])
        room = q_max[j] - q[j] if v[j] > 0.0 else q[j] - q_min[j]
        periods = max(ceil(max(T, speed / braking[j]) / dt - ROUNDING), 1)
        if speed > 0.0 and 0.5 * speed * periods * dt > room:
            most = floor(2.0 * max(room, 0.0) / (speed * dt) + ROUNDING)
            beyond = floor(2.0 * max(room + tolerance[j], 0.0) / (speed * dt) + ROUNDING)
            hardest = ceil(speed / (braking[j] * dt) - ROUNDING)
            periods = max(most, min(hardest, beyond), 1)
        times[j] = periods * dt


@compiled
def passed(
    q: Array, v: Array, times: Array, q_min: Array, q_max: Array, tolerance: Array
) -> float:
    """Return by how far a plan, or the present state, passes a position limit at worst, rad.

    Args:
        q: positions, shape (n,), rad.
        v: velocities, shape (n,), rad/s.
        times: of the plan, shape (n,), s.
        q_min: lowest positions at which joints are to stand, shape (n,), rad.
        q_max: highest, shape (n,), rad.
        tolerance: by how far they may stand beyond, shape (n,), rad.
    """
    worst = 0.0
    for j in range(q.size):
        end = q[j] + 0.5 * v[j] * times[j]
        high, low = max(q[j], end), min(q[j], end)
        worst = max(worst, max(high - q_max[j], q_min[j] - low) - tolerance[j])
    return worst


@compiled
def fill_plan(
    q: Array,
    v: Array,
    times: Array,
    positions: Array,
    velocities: Array,
    accelerations: Array,
    clock: Array,
) -> None:
    """Fill in the states and accelerations of a plan at its samples.

    Args:
        q: positions at its beginning, shape (n,), rad.
        v: velocities, shape (n,), rad/s.
        times: from `stop_times`.
        positions: of the samples, shape (samples(n), n), rad.
        velocities: shape (samples(n), n), rad/s.
        accelerations: shape (samples(n), n), rad/s^2.
        clock: their times, shape (samples(n),), s; inf at rest.
    """
    n = q.size
    T = times.max()
    for k in range(UNIFORM):
        clock[k] = k * T / UNIFORM
    for j in range(n):
        clock[UNIFORM + 2 * j] = times[j] - EDGE * T
        clock[UNIFORM + 2 * j + 1] = times[j] + EDGE * T
    clock[UNIFORM + 2 * n] = inf
    for k in range(clock.size):
        for j in range(n):
            t, a = clock[k], -v[j] / times[j]
            if t < times[j]:
                positions[k, j] = q[j] + (v[j] + 0.5 * a * t) * t
                velocities[k, j] = v[j] + a * t
                accelerations[k, j] = a
            else:
                positions[k, j] = q[j] + 0.5 * v[j] * times[j]
                velocities[k, j] = 0.0
                accelerations[k, j] = 0.0


@compiled
def sensitivity(
    dt: float,
    times: Array,
    clock: float,
    by_q: Array,
    by_v: Array,
    M: Array,
    gradient: Array,
) -> None:
    """Fill in how the torques of a sample change with the acceleration of one control step.

    With the acceleration of the plan, the rest of the plan stays what it is. With another one the
    arm is elsewhere after the step, and brakes from there in the times that are left: the torques
    at the time of the sample change by ``gradient (a - plan)``, to first order.

    Args:
        dt: control period, s.
        times: of the plan from the state in which the step begins, shape (n,), s.
        clock: time of the sample from then on, s.
        by_q: derivative of the torque by positions at the sample, shape (n, n).
        by_v: by velocities, shape (n, n).
        M: by accelerations; its upper triangle, shape (n, n).
        gradient: shape (n, n), N m s^2/rad.
    """
    n = times.size
    t = max(clock - dt, 0.0)
    for j in range(n):
        T = max(times[j] - dt, dt)
        # Of position, velocity and acceleration at the sample, by the velocity after the step.
        if t < T:
            q_v, v_v, a_v = t - 0.5 * t * t / T, 1.0 - t / T, -1.0 / T
        else:
            q_v, v_v, a_v = 0.5 * T, 0.0, 0.0
        q_a, v_a, a_a = dt * (0.5 * dt + q_v), dt * v_v, dt * a_v
        for i in range(n):
            inertia = M[i, j] if i <= j else M[j, i]
            gradient[i, j] = by_q[i, j] * q_a + by_v[i, j] * v_a + inertia * a_a
