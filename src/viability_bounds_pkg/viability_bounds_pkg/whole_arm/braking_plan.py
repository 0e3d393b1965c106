# SPDX-License-Identifier: Apache-2.0
"""Braking plans: every joint slows down at a constant rate until it stands; compiled.

From a state (q, v), with one time T for the whole arm, joint j stops within

    T_j = min(T, 2 r_j / |v_j|),    d_j = |v_j| / T_j,

r_j the distance to its position limit in the direction of its motion: it stops at time T, or
where it would pass the limit, just before it. So positions and speeds keep their limits all the
way, and what is left to check are torques. What is left of a plan after some time t is the plan
with T - t from the state then.
"""

from __future__ import annotations

from math import inf

import numpy as np
from numpy.typing import NDArray

from viability_bounds_pkg.compiled import compiled

Array = NDArray[np.float64]

UNIFORM = 20
"""Samples at equal distances in time, the first at the beginning."""

TIMED, HARDEST, AT_LIMIT = 0.0, 1.0, 2.0
"""What decides how long a joint takes."""

EDGE = 1e-9
"""How near a joint's stop the samples before and after it are, as a share of T."""


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
    braking: Array,
    dt: float,
    tolerance: Array,
    times: Array,
    kind: Array,
) -> float:
    """Fill in when each joint stands; return by how far a position limit is passed at worst, rad.

    Args:
        q: positions, shape (n,), rad.
        v: velocities, shape (n,), rad/s.
        T: time of the plan, s, at least `dt`.
        q_min: shape (n,), rad.
        q_max: shape (n,), rad.
        dt: control period, s: no joint stops sooner.
        tolerance: by how far a joint may pass a limit, shape (n,), rad.
        times: T_j, shape (n,), s.
        kind: what decides T_j, shape (n,): `TIMED`, `HARDEST` or `AT_LIMIT`.
    """
    worst = 0.0
    for j in range(q.size):
        speed = abs(v[j])
        room = (q_max[j] - q[j] if v[j] > 0.0 else q[j] - q_min[j]) + tolerance[j]
        worst = max(worst, max(q[j] - q_max[j], q_min[j] - q[j]) - tolerance[j])
        times[j], kind[j] = T, TIMED
        if speed > T * braking[j]:
            times[j], kind[j] = speed / braking[j], HARDEST
        if 0.5 * speed * times[j] > room:
            if 0.5 * speed * dt < room:
                times[j], kind[j] = 2.0 * room / speed, AT_LIMIT
            else:
                times[j], kind[j] = dt, TIMED
                worst = max(worst, 0.5 * speed * dt - room)
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
    kind: Array,
    clock: float,
    by_q: Array,
    by_v: Array,
    M: Array,
    gradient: Array,
) -> None:
    """Fill in how the torques of a sample change with the acceleration of one control step.

    With the acceleration of the plan, the rest of the plan stays what it is. With another one the
    arm is elsewhere after the step, and the plan of the time that is left, T - dt, differs: its
    torques at the time of the sample change by ``gradient (a - plan)``, to first order.

    Args:
        dt: control period, s.
        times: from `stop_times`, for the state in which the step begins.
        kind: from `stop_times`.
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
        # Of acceleration, velocity and position at the sample, by position and velocity then.
        if kind[j] == AT_LIMIT:
            # T = 2 r / v, acceleration -v^2 / (2 r).
            a_q, a_v = -2.0 / (T * T), -2.0 / T
            if t < T:
                q_q, q_v = 1.0 + 0.5 * a_q * t * t, t + 0.5 * a_v * t * t
                v_q, v_v = a_q * t, 1.0 + a_v * t
            else:
                q_q = q_v = v_q = v_v = a_q = a_v = 0.0
        elif kind[j] == HARDEST:
            a_q = a_v = v_q = 0.0
            q_q = 1.0
            q_v, v_v = (t, 1.0) if t < T else (T, 0.0)
        else:
            a_q, a_v = 0.0, -1.0 / T
            q_q, v_q = 1.0, 0.0
            if t < T:
                q_v, v_v = t - 0.5 * t * t / T, 1.0 - t / T
            else:
                q_v, v_v, a_v = 0.5 * T, 0.0, 0.0
        for i in range(n):
            inertia = M[i, j] if i <= j else M[j, i]
            of_q = by_q[i, j] * q_q + by_v[i, j] * v_q + inertia * a_q
            of_v = by_q[i, j] * q_v + by_v[i, j] * v_v + inertia * a_v
            gradient[i, j] = of_q * 0.5 * dt * dt + of_v * dt
