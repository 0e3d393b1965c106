# SPDX-License-Identifier: Apache-2.0
"""Exact joint acceleration bounds in closed form: problem (4) of [DelPrete2018].

A state is viable when position and velocity limits can be kept for ever from it. The bounds are
the accelerations, constant over one step, that keep the limits during the step and lead to a
viable state. `docs/bounds.md` derives everything below. In short, towards the upper limit, with
`room` to it and braking B:

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

from viability_bounds_pkg.joint_limits import ROUNDING, JointLimits, JointLimitsError
from viability_bounds_pkg.kernel.bounds_kernel import AccelerationBounds, solve
from viability_bounds_pkg.kernel.discrete_kernel import StoppingCurve, stopping_curves
from viability_bounds_pkg.kernel.discrete_time_condition import (
    checked_errors,
    checked_margin,
    checked_step,
    discrete_time_condition,
    kernel_braking,
    longest_steps,
    without_position_error,
)
from viability_bounds_pkg.kernel.one_sided_limit import JointTable, highest_speeds, make_table

Array = NDArray[np.float64]

__all__ = [
    "AccelerationBounds",
    "BoundsSolver",
    "acceleration_bounds",
    "discrete_time_condition",
    "viable_velocity_range",
]


class BoundsSolver:
    """Acceleration bounds of one robot; what does not depend on the state is precomputed.

    Args:
        limits: of n joints.
        dt: step, s: how long an acceleration is held. A larger value than the control period
            gives gentler bounds; see `period`.
        margin: shape (n,), rad/s^2, or None for zeros. The bounds then hold although the true
            acceleration strays from the commanded one by up to this much within a step.
        period: control period, s, at most `dt`; None means `dt`. The bounds hold for every
            period up to `dt` where condition (11) holds. Where it does not, the kernel of
            discrete time belongs to one period only: with a shorter one, the bounds fall back
            to a smaller kernel that suits them all.
        position_error: shape (n,), rad, or None for zeros. The bounds then hold although the
            true position differs from the one that they are asked for by up to this much.
        velocity_error: shape (n,), rad/s, or None for zeros; the same for the velocity.
        held: longest time for which an acceleration may act, s, at most `dt`; None means `dt`.
            Where (11) fails for `dt`, a state may allow no acceleration that could be
            held for so long; its bounds are then those of a shorter step, at least `held`, for
            which (11) holds.

    Attributes:
        limits: as given.
        dt: as given, s.
        exact: shape (n,), bool; False where the kernel is an inner approximation, because
            (11) fails and a margin, an error or a shorter period is asked for.
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
        held: float | None = None,
    ):
        self.limits = limits
        self.dt = checked_step(dt)
        period = self.dt if period is None else checked_step(period, "period")
        held = self.dt if held is None else checked_step(held, "held")
        for name, value in (("period", period), ("held", held)):
            if value > self.dt * (1.0 + ROUNDING):
                raise JointLimitsError(name, None, value, f"must be at most dt = {self.dt:g} s")
        same = period >= self.dt * (1.0 - ROUNDING)
        margins = checked_margin(margin, limits)
        off = checked_errors("position_error", position_error, limits)
        errors = checked_errors("velocity_error", velocity_error, limits)
        inner = without_position_error(limits, off)
        certain = (margins == 0.0) & (errors == 0.0) & (off == 0.0)
        braking = kernel_braking(inner, self.dt, margins, errors, exact=same & certain)
        self.exact = braking.holds | (same & certain)
        curved = self.exact & ~braking.holds
        steps = np.full(len(limits), self.dt)
        self.table = _make_table(inner, steps, margins, errors, braking.deceleration, curved)
        # A joint counts as inside if it may be.
        self.table.limits["tolerance"] += 2.0 * off[:, None]
        steps = longest_steps(inner, self.dt, held, margins, errors)
        changed = steps < self.dt
        if changed.any():
            full = np.stack([-limits.a_min, limits.a_max], axis=1) - margins[:, None]
            none = np.zeros_like(changed)
            made = _make_table(inner, steps, margins, errors, full, none)
            shorter = np.where(changed[:, None], made.limits, self.table.limits)
            self.table = self.table._replace(shorter=shorter)
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
        q = np.asarray(q, dtype=np.float64)
        v = np.asarray(v, dtype=np.float64)
        n = len(self.limits)
        if q.shape != v.shape or q.ndim not in (1, 2) or q.shape[-1] != n:
            shapes = f"with q of shape {q.shape} and v of shape {v.shape}"
            allowed = f"both must have shape ({n},) or (batch, {n})"
            raise JointLimitsError("state", None, shapes, allowed)
        return solve(q, v, self.table)

    def velocity_range(self, q: ArrayLike) -> tuple[Array, Array]:
        """Return the lowest and highest viable velocity at positions `q`.

        Args:
            q: shape (n,) or (batch, n), rad.

        Returns:
            Two arrays of the shape of `q`, rad/s; nan where `q` is outside its limits.
        """
        q = np.asarray(q, dtype=np.float64)
        lower, upper = np.empty_like(q), np.empty_like(q)
        above, below = self.limits.q_max - q, q - self.limits.q_min
        for j, (up, lo) in enumerate(self.table.limits):
            upper[..., j] = highest_speeds(above[..., j], up, self.table.curves)
            lower[..., j] = -highest_speeds(below[..., j], lo, self.table.curves)
        outside = (above < 0.0) | (below < 0.0)
        lower[outside] = upper[outside] = np.nan
        return lower, upper


def acceleration_bounds(
    q: ArrayLike,
    v: ArrayLike,
    limits: JointLimits,
    dt: float,
    margin: ArrayLike | None = None,
    period: float | None = None,
    *,
    position_error: ArrayLike | None = None,
    velocity_error: ArrayLike | None = None,
) -> AccelerationBounds:
    """Return the largest interval of accelerations that keeps the limits for ever: problem (4).

    A function for `BoundsSolver(limits, dt, ...).bounds(q, v)`, which documents arguments and
    errors; the solver is kept for the next call with the same settings.
    """
    if margin is not None:
        margin = tuple(checked_margin(margin, limits).tolist())
    if position_error is not None:
        errors = checked_errors("position_error", position_error, limits)
        position_error = tuple(errors.tolist())
    if velocity_error is not None:
        errors = checked_errors("velocity_error", velocity_error, limits)
        velocity_error = tuple(errors.tolist())
    return _solver(limits, dt, margin, period, position_error, velocity_error).bounds(q, v)


_Numbers = tuple[float, ...] | None


@lru_cache(maxsize=32)
def _solver(
    limits: JointLimits,
    dt: float,
    margin: _Numbers,
    period: float | None,
    position_error: _Numbers,
    velocity_error: _Numbers,
) -> BoundsSolver:
    return BoundsSolver(
        limits, dt, margin, period, position_error=position_error, velocity_error=velocity_error
    )


def viable_velocity_range(
    q: ArrayLike, limits: JointLimits, margin: ArrayLike | None = None
) -> tuple[Array, Array]:
    """Return the velocities from which the limits can be kept in continuous time: eq. (8)-(10).

    Where condition (11) holds this is also the kernel of discrete time; where it does not, ask
    `BoundsSolver.velocity_range`.

    Args:
        q: shape (n,) or (batch, n), rad.
        limits: of n joints.
        margin: shape (n,), rad/s^2, or None; taken off the braking.

    Returns:
        Lowest and highest velocity, each of the shape of `q`, rad/s; nan outside the limits.
    """
    q = np.asarray(q, dtype=np.float64)
    margins = checked_margin(margin, limits)
    above, below = limits.q_max - q, q - limits.q_min
    with np.errstate(invalid="ignore"):
        upper = np.minimum(np.sqrt(2.0 * (-limits.a_min - margins) * above), limits.v_max)
        lower = -np.minimum(np.sqrt(2.0 * (limits.a_max - margins) * below), limits.v_max)
    outside = (above < 0.0) | (below < 0.0)
    return np.where(outside, np.nan, lower), np.where(outside, np.nan, upper)


def _make_table(
    limits: JointLimits,
    steps: Array,
    margins: Array,
    velocity_errors: Array,
    braking: Array,
    curved: NDArray[np.bool_],
) -> JointTable:
    """Return the kernel's table.

    `steps` is of shape (n,), s; `braking` of shape (n, 2), towards the upper and the lower limit,
    rad/s^2; `curved`, shape (n,), tells which kernels are those of discrete time.
    """
    ranges = np.stack([limits.q_max, -limits.q_min], axis=1)
    length = ranges.sum(axis=1, keepdims=True)
    v_max = limits.v_max[:, None]
    largest = np.abs(np.where(np.isfinite(ranges), ranges, 0.0)).max(axis=1, keepdims=True)
    curves: list[tuple[StoppingCurve | None, StoppingCurve | None]] = [(None, None)] * len(limits)
    for j in np.flatnonzero(curved):
        dt = float(steps[j])
        up, lo = (b * dt * dt for b in braking[j].tolist())
        curves[j] = stopping_curves(float(length[j, 0]), float(limits.v_max[j]) * dt, (up, lo))
    return make_table(
        dt=steps[:, None],
        position=ranges,
        braking=braking,
        v_max=v_max,
        low=np.stack([limits.a_min, -limits.a_max], axis=1),
        high=np.stack([limits.a_max, -limits.a_min], axis=1),
        margin=margins[:, None],
        velocity_error=velocity_errors[:, None],
        tolerance=ROUNDING * (largest + np.minimum(v_max * v_max / (2.0 * braking), length)),
        curves=curves,
    )
