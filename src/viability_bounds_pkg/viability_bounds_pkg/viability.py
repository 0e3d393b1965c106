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

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from viability_bounds_pkg.joint_limits import ROUNDING, JointLimits, JointLimitsError
from viability_bounds_pkg.kernel.bounds_kernel import make_table, solve
from viability_bounds_pkg.kernel.braking import Side, highest_speeds, make_side
from viability_bounds_pkg.kernel.discrete_kernel import StoppingCurve, stopping_curves
from viability_bounds_pkg.kernel.discrete_time_condition import (
    KernelBraking,
    checked_margin,
    checked_step,
    condition_11,
    kernel_braking,
)

__all__ = [
    "AccelerationBounds",
    "BoundsSolver",
    "acceleration_bounds",
    "condition_11",
    "viable_velocity_range",
]


class AccelerationBounds(NamedTuple):
    """Interval of joint accelerations that keeps the limits.

    Attributes:
        lower: shape of the state, rad/s^2; ``a_min <= lower <= upper <= a_max``.
        upper: shape of the state, rad/s^2.
        viable: shape of the state, bool; False where the joint is outside the kernel, so that
            a limit is or will be broken whatever is done, and the interval brings it back.
    """

    lower: NDArray[np.float64]
    upper: NDArray[np.float64]
    viable: NDArray[np.bool_]


class BoundsSolver:
    """Acceleration bounds of one robot, with everything that does not depend on the state.

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

    Attributes:
        limits: as given.
        dt: as given, s.
        exact: shape (n,), bool; False where the kernel is an inner approximation, because
            (11) fails and either a margin or a shorter period is asked for.
        table: the constants that `bounds_kernel.solve` takes.

    Raises:
        JointLimitsError: `dt`, `margin` or `period` is unusable; the message names the joint.
    """

    def __init__(
        self,
        limits: JointLimits,
        dt: float,
        margin: ArrayLike | None = None,
        period: float | None = None,
    ):
        self.limits = limits
        self.dt = checked_step(dt)
        period = self.dt if period is None else checked_step(period, "period")
        if period > self.dt * (1.0 + ROUNDING):
            raise JointLimitsError("period", None, period, f"must be at most dt = {self.dt:g} s")
        same = period >= self.dt * (1.0 - ROUNDING)
        margins = checked_margin(margin, limits)
        braking = kernel_braking(limits, self.dt, margins, exact=same)
        self.exact = np.array(
            [b.holds or (same and w == 0.0) for b, w in zip(braking, margins, strict=True)]
        )
        self._joints = [
            _joint_sides(limits, j, self.dt, w, braking[j], bool(self.exact[j]))
            for j, w in enumerate(margins.tolist())
        ]
        self.table = make_table(self._joints)
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
            ValueError: the shapes differ, or do not fit the number of joints.
        """
        q = np.asarray(q, dtype=np.float64)
        v = np.asarray(v, dtype=np.float64)
        n = len(self._joints)
        if q.shape != v.shape or q.ndim not in (1, 2) or q.shape[-1] != n:
            raise ValueError(
                f"q {q.shape} and v {v.shape} must both have shape ({n},) or (batch, {n})"
            )
        states = (q.size // n, n)
        lower, upper = np.empty(q.shape), np.empty(q.shape)
        viable = np.empty(q.shape, dtype=np.bool_)
        solve(
            q.reshape(states),
            v.reshape(states),
            *self.table,
            lower.reshape(states),
            upper.reshape(states),
            viable.reshape(states),
        )
        return AccelerationBounds(lower, upper, viable)

    def velocity_range(self, q: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the lowest and highest viable velocity at positions `q`.

        Args:
            q: shape (n,) or (batch, n), rad.

        Returns:
            Two arrays of the shape of `q`, rad/s; nan where `q` is outside its limits.
        """
        q = np.asarray(q, dtype=np.float64)
        lower, upper = np.empty_like(q), np.empty_like(q)
        for j, (q_min, q_max, _, up, lo) in enumerate(self._joints):
            above, below = q_max - q[..., j], q[..., j] - q_min
            outside = (above < 0.0) | (below < 0.0)
            upper[..., j] = np.where(outside, np.nan, highest_speeds(above, up))
            lower[..., j] = np.where(outside, np.nan, -highest_speeds(below, lo))
        return lower, upper


def acceleration_bounds(
    q: ArrayLike,
    v: ArrayLike,
    limits: JointLimits,
    dt: float,
    margin: ArrayLike | None = None,
    period: float | None = None,
) -> AccelerationBounds:
    """Return the largest interval of accelerations that keeps the limits for ever: problem (4).

    A function for `BoundsSolver(limits, dt, margin, period).bounds(q, v)`, which documents the
    arguments; the solver is kept for the next call with the same settings.

    Args:
        q: shape (n,) or (batch, n), rad.
        v: same shape, rad/s.
        limits: of n joints.
        dt: step, s.
        margin: shape (n,), rad/s^2, or None.
        period: control period, s, at most `dt`; None means `dt`.

    Raises:
        JointLimitsError: `dt`, `margin` or `period` is unusable.
        ValueError: the shapes of `q` and `v` do not fit.
    """
    if margin is not None:
        margin = tuple(checked_margin(margin, limits).tolist())
    return _solver(limits, dt, margin, period).bounds(q, v)


@lru_cache(maxsize=32)
def _solver(limits, dt, margin, period) -> BoundsSolver:
    return BoundsSolver(limits, dt, margin, period)


def viable_velocity_range(
    q: ArrayLike, limits: JointLimits, margin: ArrayLike | None = None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
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


def _joint_sides(
    limits: JointLimits, j: int, dt: float, margin: float, braking: KernelBraking, exact: bool
) -> tuple[float, float, float, Side, Side]:
    """Return q_min, q_max, the speed that still counts as viable, and both sides of joint j."""
    q_min, q_max = float(limits.q_min[j]), float(limits.q_max[j])
    v_max = float(limits.v_max[j])
    a_min, a_max = float(limits.a_min[j]), float(limits.a_max[j])
    decelerations = (braking.upper, braking.lower)
    curves: tuple[StoppingCurve | None, ...] = (None, None)
    if exact and not braking.holds:
        curves = stopping_curves(
            q_max - q_min, v_max * dt, tuple(b * dt * dt for b in decelerations)
        )
    largest = max(abs(x) for x in (q_min, q_max, 0.0) if math.isfinite(x))
    sides = [
        make_side(
            dt=dt,
            braking=b,
            v_max=v_max,
            low=low,
            high=high,
            margin=margin,
            tolerance=ROUNDING * (largest + min(v_max * v_max / (2.0 * b), q_max - q_min)),
            length=q_max - q_min,
            curve=curve if math.isfinite(limit) else None,
        )
        for b, limit, low, high, curve in zip(
            decelerations, (q_max, q_min), (a_min, -a_max), (a_max, -a_min), curves, strict=True
        )
    ]
    return q_min, q_max, v_max * (1.0 + ROUNDING), *sides
