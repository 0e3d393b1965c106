# SPDX-License-Identifier: Apache-2.0
"""Exact joint acceleration bounds in closed form: problem (4) of [DelPrete2018].

A state is viable when position and velocity limits can be kept for ever from it. The bounds are
the accelerations, constant over one step, that keep the limits during the step and lead to a
viable state. `docs/theory/bounds.md` derives everything below. In short, towards the upper limit,
with `room` to it and braking B:

- the step may end with velocity w >= 0 when the joint can still stop afterwards, which holds for
  ``dt w / 2 + w^2 / (2 B) <= room - dt v / 2``; the largest such w gives (w - v) / dt;
- when not even w = 0 fits, the joint must stop within the step: -v^2 / (2 room), eq. (19).

The lower limit is the mirror image. This is Algorithms 1 to 3 without their case distinctions,
for asymmetric limits, and with an answer for states that are not viable.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from viability_bounds_pkg.bounds.discrete_time import Margins, checked_step, discrete_time
from viability_bounds_pkg.bounds.kernel import (
    AccelerationBounds,
    bounds_of_states,
    knee_speed,
    make_table,
    solve,
)
from viability_bounds_pkg.joint_limits import ROUNDING, JointLimits, JointLimitsError

Array = NDArray[np.float64]

__all__ = [
    "AccelerationBounds",
    "BoundsSolver",
    "acceleration_bounds",
    "viable_velocity_range",
]


class BoundsSolver:
    """Acceleration bounds of one robot; what does not depend on the state is precomputed.

    Args:
        limits: of n joints.
        dt: step, s: how long an acceleration is assumed to last. A larger value than the control
            period gives gentler bounds; see `period`.
        margin: shape (n,), rad/s^2, or None for zeros. The bounds then hold although the true
            acceleration strays from the commanded one by up to this much within a step.
        period: longest time for which an acceleration acts, s, at most `dt`; None means `dt`.
            Joints for which condition (11) fails with `dt` get a shorter step, at least `period`,
            for which it holds. If it fails with `period`, too, their braking is reduced.
        position_error: shape (n,), rad, or None for zeros. The bounds then hold although the
            true position differs from the one that they are asked for by up to this much.
        velocity_error: shape (n,), rad/s, or None for zeros; the same for the velocity.

    Attributes:
        limits: as given.
        steps: the step of each joint, shape (n,), s.
        braking: deceleration that the kernel counts on, towards the upper and the lower limit,
            shape (n, 2), rad/s^2.
        exact: shape (n,), bool; False where the braking was reduced, so that the kernel is an
            inner approximation.
        table: the constants that `solve` takes.

    Raises:
        JointLimitsError: an argument is unusable; the message names the joint.
    """

    def __init__(
        self,
        limits: JointLimits,
        dt: float,
        margin: ArrayLike | None = None,
        period: float | None = None,
        *,
        position_error: ArrayLike | None = None,
        velocity_error: ArrayLike | None = None,
    ):
        self.limits = limits
        dt = checked_step(dt)
        period = dt if period is None else checked_step(period, "period")
        if period > dt * (1.0 + ROUNDING):
            raise JointLimitsError("period", None, period, f"must be at most dt = {dt:g} s")
        margins = Margins.of(limits, margin, position_error, velocity_error)
        self.steps, self.braking, self.exact = discrete_time(limits, dt, period, margins)
        self.table = make_table(limits, self.steps, self.braking, margins)
        # The first call compiles; let it be this one and not one in a control loop.
        self.bounds(np.zeros(len(limits)), np.zeros(len(limits)))

    def bounds(self, q: ArrayLike, v: ArrayLike) -> AccelerationBounds:
        """Return the acceleration bounds at one state or a batch of states.

        Args:
            q: shape (n,) or (batch, n), rad.
            v: same shape, rad/s.

        Values that are not finite are the caller's to refuse; for such a joint `viable` is
        False and the interval is inside the acceleration limits, but means nothing.

        Raises:
            JointLimitsError: the shapes differ, or do not fit the number of joints.
        """
        return bounds_of_states(solve, self.table, q, v)

    def velocity_range(self, q: ArrayLike) -> tuple[Array, Array]:
        """Return the lowest and highest viable velocity at positions `q`.

        Args:
            q: shape (n,) or (batch, n), rad.

        Returns:
            Two arrays of the shape of `q`, rad/s; nan where `q` is outside its limits.
        """
        return _velocity_range(np.asarray(q, dtype=np.float64), self.limits, self.braking)


def acceleration_bounds(
    q: ArrayLike, v: ArrayLike, limits: JointLimits, dt: float
) -> AccelerationBounds:
    """Return the largest interval of accelerations that keeps the limits for ever: problem (4).

    A function for `BoundsSolver(limits, dt).bounds(q, v)`, which documents arguments and errors;
    the solver is kept for the next call with the same limits.
    """
    return _solver(limits, dt).bounds(q, v)


@lru_cache(maxsize=32)
def _solver(limits: JointLimits, dt: float) -> BoundsSolver:
    return BoundsSolver(limits, dt)


def viable_velocity_range(q: ArrayLike, limits: JointLimits) -> tuple[Array, Array]:
    """Return the velocities from which the limits can be kept in continuous time: eq. (8)-(10).

    Where condition (11) holds this is also the kernel of discrete time; where it does not, the
    bounds keep to the smaller one of `BoundsSolver.velocity_range`.

    Args:
        q: shape (n,) or (batch, n), rad.
        limits: of n joints.

    Returns:
        Lowest and highest velocity, each of the shape of `q`, rad/s; nan outside the limits.
    """
    braking = np.stack([-limits.a_min, limits.a_max], axis=1)
    return _velocity_range(np.asarray(q, dtype=np.float64), limits, braking)


def _velocity_range(q: Array, limits: JointLimits, braking: Array) -> tuple[Array, Array]:
    """Return the velocities from which the limits are kept with `braking`, shape (n, 2)."""
    above, below = limits.q_max - q, q - limits.q_min
    lowest, highest = limits.velocities(q)
    c, d, knees = limits.velocity_offset, limits.deceleration_limit, knee_speed(limits, braking)

    def viable(allowed: Array, room: Array, side: int) -> Array:
        # Above the knee the parabola of full braking, v^2 <= 2 B (room - c^2 / (2 (d - B))).
        knee = np.where(np.isfinite(knees), knees, 0.0)[:, side]
        parabola = 2.0 * braking[:, side] * (room - 0.5 * c * (c + knee) / d)
        slowed = np.minimum(np.sqrt(np.maximum(parabola, 0.0)), allowed)
        return np.where(allowed > knees[:, side], slowed, allowed)

    upper, lower = viable(highest, above, 0), -viable(-lowest, below, 1)
    outside = (above < 0.0) | (below < 0.0)
    return np.where(outside, np.nan, lower), np.where(outside, np.nan, upper)
