# SPDX-License-Identifier: Apache-2.0
"""Algorithms 1 to 3 of [DelPrete2018] as printed, for comparison and for Fig. 3.

`viability.acceleration_bounds` replaces them: these assume a viable state and condition (11),
and return conflicting or huge bounds, or a nan, elsewhere. What differs from the print:

- asymmetric limits: towards the upper position limit the paper's ddq_max is ``-a_min``, towards
  the lower one ``a_max``;
- the branch ``v >= 0`` of Algorithm 1 is ``v > 0``, as eq. (17) has it; at rest on a limit the
  print would compute 0 / 0.

Arguments are those of `viability.acceleration_bounds`; bounds are (lower, upper), not ordered and
not clipped, of the shape of the state, rad/s^2.
"""

import numpy as np


def position_bounds(q, v, limits, dt):
    """Return the bounds that keep the position limits during the step: Algorithm 1."""
    with np.errstate(divide="ignore", invalid="ignore"):
        a1 = -v / dt
        a2_upper = -v * v / (2.0 * (limits.q_max - q))
        a2_lower = v * v / (2.0 * (q - limits.q_min))
    a3_upper = 2.0 * (limits.q_max - q - dt * v) / dt**2
    a3_lower = 2.0 * (limits.q_min - q - dt * v) / dt**2
    stops_above = (v > 0.0) & (a3_upper <= a1)
    stops_below = (v < 0.0) & (a3_lower >= a1)
    return (
        np.where(stops_below, np.maximum(a1, a2_lower), a3_lower),
        np.where(stops_above, np.minimum(a1, a2_upper), a3_upper),
    )


def viability_bounds(q, v, limits, dt):
    """Return the bounds that lead into the kernel of eq. (10): Algorithm 2."""
    a1, a = -v / dt, dt**2
    braking = -limits.a_min
    b = dt * (2.0 * v + braking * dt)
    c = v * v - 2.0 * braking * (limits.q_max - q - dt * v)
    delta = b * b - 4.0 * a * c
    root = (-b + np.sqrt(np.maximum(delta, 0.0))) / (2.0 * a)
    upper = np.where(delta >= 0.0, np.maximum(a1, root), a1)
    braking = limits.a_max
    b = dt * (2.0 * v - braking * dt)
    c = v * v - 2.0 * braking * (q + dt * v - limits.q_min)
    delta = b * b - 4.0 * a * c
    root = (-b - np.sqrt(np.maximum(delta, 0.0))) / (2.0 * a)
    lower = np.where(delta >= 0.0, np.minimum(a1, root), a1)
    return lower, upper


def _all_bounds(q, v, limits, dt):
    """Return lower and upper bounds, in the order of Algorithm 3."""
    q, v = np.broadcast_arrays(np.asarray(q, dtype=float), np.asarray(v, dtype=float))
    constant = np.ones_like(v)
    rows = [
        position_bounds(q, v, limits, dt),
        ((-limits.v_max - v) / dt, (limits.v_max - v) / dt),  # eq. (23)
        viability_bounds(q, v, limits, dt),
        (limits.a_min * constant, limits.a_max * constant),
    ]
    return np.stack([row[0] for row in rows]), np.stack([row[1] for row in rows])


def combined_bounds(q, v, limits, dt):
    """Return the tightest of all bounds: Algorithm 3."""
    lower, upper = _all_bounds(q, v, limits, dt)
    return lower.max(axis=0), upper.min(axis=0)


def active_upper_bounds(q, v, limits, dt):
    """Return what gives the upper bound: Fig. 3.

    0 is position, 1 velocity, 2 viability, 3 acceleration.
    """
    return _all_bounds(q, v, limits, dt)[1].argmin(axis=0)
