# SPDX-License-Identifier: Apache-2.0
"""Other ways to bound joint accelerations, for comparison with `viability.acceleration_bounds`.

They share its signature. None of them keeps the limits in general; where a method contradicts
itself, `viable` is False and the interval is what a controller can still use of it: each bound
clipped to the acceleration limits and, if they still cross, both set to their mean.

- `naive_bounds`: eq. (2) of [DelPrete2018]. A larger `dt` than the control period makes it
  gentler.
- `decre_bounds`, `rubrecht_bounds`: formulas for velocity control [Decre2009, Rubrecht2012],
  reconstructed from what [DelPrete2018] says of them. The joint is taken to move with one velocity
  u throughout the step and to change it from step to step by at most ``a dt``, a
  pseudo-acceleration.

Arguments of all: position q and velocity v, shape (n,) or (batch, n), rad and rad/s; the limits of
n joints; the step dt, s.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from viability_bounds_pkg.joint_limits import JointLimits
from viability_bounds_pkg.viability import AccelerationBounds

Array = NDArray[np.float64]


def naive_bounds(q: ArrayLike, v: ArrayLike, limits: JointLimits, dt: float) -> AccelerationBounds:
    """Return the accelerations that keep the limits at the end of one step: eq. (2)."""
    q, v = np.asarray(q, dtype=np.float64), np.asarray(v, dtype=np.float64)
    lower = np.maximum((-limits.v_max - v) / dt, 2.0 * (limits.q_min - q - dt * v) / dt**2)
    upper = np.minimum((limits.v_max - v) / dt, 2.0 * (limits.q_max - q - dt * v) / dt**2)
    return _usable(lower, upper, limits)


def decre_velocity_range(q: ArrayLike, limits: JointLimits, dt: float) -> tuple[Array, Array]:
    """Return the velocities for the next step that [Decre2009] allows (reconstruction).

    ``u <= min(v_max, sqrt(2 a room), room / dt)``: the joint can brake in time if it starts at
    once, and is inside when the step ends. Towards the upper limit a is ``-a_min``. The lowest and
    the highest velocity have the shape of `q`, rad/s.
    """

    def towards(room: Array, braking: Array) -> Array:
        return np.minimum(np.sqrt(2.0 * braking * np.maximum(room, 0.0)), room / dt)

    return _velocity_range(q, limits, towards)


def rubrecht_velocity_range(q: ArrayLike, limits: JointLimits, dt: float) -> tuple[Array, Array]:
    """Return the velocities for the next step that [Rubrecht2012] allows (reconstruction).

    ``dt u + u^2 / (2 a) <= room``: the joint can brake in time after a step at velocity u. Then
    ``u - a dt`` is always allowed in the next step, so that there is no conflict. The lowest and
    the highest velocity have the shape of `q`, rad/s.
    """

    def towards(room: Array, braking: Array) -> Array:
        inside = np.maximum(room, 0.0)
        k = braking * dt
        allowed = np.sqrt(k * k + 2.0 * braking * inside) - k
        return np.where(room >= 0.0, allowed, room / dt)

    return _velocity_range(q, limits, towards)


def decre_bounds(q: ArrayLike, v: ArrayLike, limits: JointLimits, dt: float) -> AccelerationBounds:
    """Return the accelerations that end the step inside `decre_velocity_range`."""
    return _to_reach(v, decre_velocity_range(q, limits, dt), limits, dt)


def rubrecht_bounds(
    q: ArrayLike, v: ArrayLike, limits: JointLimits, dt: float
) -> AccelerationBounds:
    """Return the accelerations that end the step inside `rubrecht_velocity_range`."""
    return _to_reach(v, rubrecht_velocity_range(q, limits, dt), limits, dt)


def _velocity_range(
    q: ArrayLike, limits: JointLimits, towards: Callable[[Array, Array], Array]
) -> tuple[Array, Array]:
    q = np.asarray(q, dtype=np.float64)
    upper = towards(limits.q_max - q, -limits.a_min)
    lower = -towards(q - limits.q_min, limits.a_max)
    return np.maximum(lower, -limits.v_max), np.minimum(upper, limits.v_max)


def _to_reach(
    v: ArrayLike, velocity_range: tuple[Array, Array], limits: JointLimits, dt: float
) -> AccelerationBounds:
    v = np.asarray(v, dtype=np.float64)
    low, high = velocity_range
    return _usable((low - v) / dt, (high - v) / dt, limits)


def _usable(lower: Array, upper: Array, limits: JointLimits) -> AccelerationBounds:
    viable = np.maximum(lower, limits.a_min) <= np.minimum(upper, limits.a_max)
    lower = np.clip(lower, limits.a_min, limits.a_max)
    upper = np.clip(upper, limits.a_min, limits.a_max)
    mean = 0.5 * (lower + upper)
    crossed = lower > upper
    return AccelerationBounds(
        np.where(crossed, mean, lower), np.where(crossed, mean, upper), viable
    )
