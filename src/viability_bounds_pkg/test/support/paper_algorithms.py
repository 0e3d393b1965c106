# SPDX-License-Identifier: Apache-2.0
"""Algorithms 1 to 3 of [DelPrete2018] as printed, for comparison and for Fig. 3.

`viability.acceleration_bounds` replaces them: these assume a viable state and condition (11),
and return conflicting or huge bounds, or a nan, elsewhere. What differs from the print:

- asymmetric limits: towards the upper position limit the paper's ddq_max is ``-a_min``, towards
  the lower one ``a_max``;
- the branch ``v >= 0`` of Algorithm 1 is ``v > 0``, as eq. (17) has it; at rest on a limit the
  print would compute 0 / 0.

States have shape (n,) or (batch, n), rad and rad/s; bounds are in rad/s^2.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from viability_bounds_pkg.joint_limits import JointLimits

Array = NDArray[np.float64]


class Interval(NamedTuple):
    """Bounds on the acceleration, of the shape of the state, rad/s^2; not ordered, not clipped."""

    lower: Array
    upper: Array


CONSTRAINTS = ("position", "velocity", "viability", "acceleration")
"""What `active_upper_bounds` counts, in the order of Algorithm 3."""


def position_bounds(q: ArrayLike, v: ArrayLike, limits: JointLimits, dt: float) -> Interval:
    """Return the bounds that keep the position limits during the step: Algorithm 1."""
    q, v = np.asarray(q, dtype=np.float64), np.asarray(v, dtype=np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        a1 = -v / dt
        a2_upper = -v * v / (2.0 * (limits.q_max - q))
        a2_lower = v * v / (2.0 * (q - limits.q_min))
    a3_upper = 2.0 * (limits.q_max - q - dt * v) / dt**2
    a3_lower = 2.0 * (limits.q_min - q - dt * v) / dt**2
    stops_above = (v > 0.0) & (a3_upper <= a1)
    stops_below = (v < 0.0) & (a3_lower >= a1)
    return Interval(
        np.where(stops_below, np.maximum(a1, a2_lower), a3_lower),
        np.where(stops_above, np.minimum(a1, a2_upper), a3_upper),
    )


def velocity_bounds(q: ArrayLike, v: ArrayLike, limits: JointLimits, dt: float) -> Interval:
    """Return the bounds that keep the velocity limits at the end of the step: eq. (23)."""
    v = np.asarray(v, dtype=np.float64)
    return Interval((-limits.v_max - v) / dt, (limits.v_max - v) / dt)


def viability_bounds(q: ArrayLike, v: ArrayLike, limits: JointLimits, dt: float) -> Interval:
    """Return the bounds that lead into the kernel of eq. (10): Algorithm 2."""
    q, v = np.asarray(q, dtype=np.float64), np.asarray(v, dtype=np.float64)
    a1 = -v / dt
    a = dt**2
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
    return Interval(lower, upper)


def combined_bounds(q: ArrayLike, v: ArrayLike, limits: JointLimits, dt: float) -> Interval:
    """Return the tightest of all bounds: Algorithm 3."""
    lower, upper = _stacked(q, v, limits, dt)
    return Interval(lower.max(axis=0), upper.min(axis=0))


def active_upper_bounds(
    q: ArrayLike, v: ArrayLike, limits: JointLimits, dt: float
) -> NDArray[np.intp]:
    """Return which of `CONSTRAINTS` gives the upper bound, of the shape of the state: Fig. 3."""
    return _stacked(q, v, limits, dt).upper.argmin(axis=0)


def _stacked(q: ArrayLike, v: ArrayLike, limits: JointLimits, dt: float) -> Interval:
    position = position_bounds(q, v, limits, dt)
    rows = [
        position,
        velocity_bounds(q, v, limits, dt),
        viability_bounds(q, v, limits, dt),
        Interval(
            np.broadcast_to(limits.a_min, position.lower.shape),
            np.broadcast_to(limits.a_max, position.upper.shape),
        ),
    ]
    return Interval(np.stack([r.lower for r in rows]), np.stack([r.upper for r in rows]))
