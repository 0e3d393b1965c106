# SPDX-License-Identifier: Apache-2.0
"""Acceleration bounds of joints whose acceleration may change by a limited amount in each step.

A state is position, velocity and the acceleration of the last step. Towards the upper limit the
hardest braking after a first acceleration a is, step by step,

    a, a - d, a - 2 d, ..., -B, -B, ...

with d the change that is allowed from step to step. A motion with more acceleration is at all
times faster and farther on, so the largest a whose hardest braking keeps the limit is the upper
bound.
The lower limit is the mirror image. `docs/theory/jerk.md` shows when both go together: then the
bounds are exact. Where they do not, B is reduced.
"""

from __future__ import annotations

from math import ceil, floor, sqrt

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from viability_bounds_pkg.bounds.discrete_time import Margins, checked_step
from viability_bounds_pkg.bounds.kernel import AccelerationBounds, bounds_of_states
from viability_bounds_pkg.joint_limits import ROUNDING, JointLimits, JointLimitsError, joint_array

Array = NDArray[np.float64]

_STEPS = 40
"""At most, of Newton's method; it takes about four."""

_ENOUGH = 1e-7
"""Newton's method ends after a smaller change, as shares of the drop; the error is its square."""

_HALVINGS = 50
"""Of the interval in which the largest braking is searched."""

_SLACK = 1e-6
"""Share of the range that reduced braking leaves, as rounding at one limit grows at the other."""

_FIELDS = (
    "position", "v_max", "dt", "drop", "change", "braking", "low", "high", "margin",
    "room_tolerance", "speed_tolerance"
)  # fmt: skip
ONE_SIDED_LIMIT = np.dtype([(name, np.float64) for name in _FIELDS], align=True)
"""One position limit of one joint, as compiled code reads it by name.

- position: of the limit, rad; the room is ``position - q``, for the lower limit ``position + q``.
- v_max: speed limit, rad/s.
- dt: step, s.
- drop: d, rad/s^2.
- change: by which the next acceleration may differ from the last one, rad/s^2.
- braking: B, the deceleration that is sure, rad/s^2.
- low, high: hardest accelerations away from the limit and towards it, rad/s^2.
- margin: by which the true acceleration may be off, rad/s^2.
- room_tolerance, speed_tolerance: what a state may lack and still count as viable, rad, rad/s^2.
"""


class JerkBoundsSolver:
    """Bounds of accelerations, of which one differs from the last one by at most ``jerk period``.

    Args:
        limits: of n joints, whose speed limits do not depend on positions.
        jerk: largest rate of change of the acceleration, shape (n,), rad/s^3, up or down.
        period: control period, s.
        dt: step, s: how long an acceleration is assumed to last, at least `period`; None means
            `period`.
        margin: shape (n,), rad/s^2, or None for zeros: by how much the true acceleration may
            differ from the commanded one.

    Attributes:
        limits: as given.
        braking: largest decelerations that the bounds ask for, towards the upper and the lower
            limit, shape (n, 2), rad/s^2.
        exact: shape (n,), bool; False where these had to be reduced, so that the bounds are
            narrower than need be.

    Raises:
        JointLimitsError: an argument is unusable; the message names the joint.
    """

    def __init__(
        self,
        limits: JointLimits,
        jerk: ArrayLike,
        period: float,
        dt: float | None = None,
        margin: ArrayLike | None = None,
    ) -> None:
        self.limits = limits
        jerk = joint_array("jerk", jerk, limits.names)
        for name, value in zip(limits.names, jerk.tolist(), strict=True):
            if not 0.0 < value < np.inf:
                raise JointLimitsError("jerk", name, value, "must be finite and positive")
        for name, value in zip(limits.names, limits.deceleration_limit.tolist(), strict=True):
            if value < np.inf:
                allowed = "must be inf where the jerk is limited"
                raise JointLimitsError("deceleration_limit", name, value, allowed)
        period = checked_step(period, "period")
        dt = period if dt is None else checked_step(dt)
        if dt < period * (1.0 - ROUNDING):
            raise JointLimitsError("dt", None, dt, f"must be at least period = {period:g} s")
        table = _make_table(limits, jerk, period, dt, margin)
        full = -table["low"]
        self.braking = np.array(
            [_largest_braking(name, each) for name, each in zip(limits.names, table, strict=True)]
        )
        self.exact: NDArray[np.bool_] = (self.braking == full).all(axis=1)
        _set_braking(table, self.braking)
        self._table = table
        zero = np.zeros(len(limits))
        self.bounds(zero, zero, zero)  # the first call compiles

    def bounds(
        self, q: ArrayLike, v: ArrayLike, a: ArrayLike, highest: ArrayLike | None = None
    ) -> AccelerationBounds:
        """Return the acceleration bounds at one state or a batch of states.

        Args:
            q: shape (n,) or (batch, n), rad.
            v: same shape, rad/s.
            a: acceleration of the last step, same shape, rad/s^2. From one beyond its limits the
                bounds lead back as the jerk allows, and are beyond them, too, till then.
            highest: what `a` may have been at most, where it is not known; `a` is then the least.
                The bounds hold for all between. None: it is known.

        For values that are not finite `viable` is False, and the interval means nothing.

        Raises:
            JointLimitsError: the shapes differ, or do not fit the number of joints.
        """
        return bounds_of_states(_solve, self._table, q, v, a, a if highest is None else highest)


def _make_table(
    limits: JointLimits, jerk: Array, period: float, dt: float, margin: ArrayLike | None
) -> NDArray[np.void]:
    """Return the limits of n joints, `ONE_SIDED_LIMIT` of shape (n, 2): upper and lower.

    Raises:
        JointLimitsError: a margin is negative, or too large.
    """
    w = Margins.of(limits, margin, None, None).acceleration
    for name, each, speed, drop in zip(
        limits.names, w.tolist(), limits.v_max / dt, jerk * dt, strict=True
    ):
        if each > (most := 0.5 * _fastest(speed, drop)):
            allowed = f"must be at most {most:.3g} rad/s^2 with this jerk"
            raise JointLimitsError("margin", name, each, allowed)
    table = np.zeros((len(limits), 2), dtype=ONE_SIDED_LIMIT)
    table["position"] = np.stack([limits.q_max, -limits.q_min], axis=1)
    table["dt"] = dt
    for field, value in (
        ("v_max", limits.v_max), ("drop", jerk * dt), ("change", jerk * period), ("margin", w)
    ):  # fmt: skip
        table[field] = value[:, None]
    _set_braking(table, np.stack([-limits.a_min, limits.a_max], axis=1))
    return table


def _set_braking(table: NDArray[np.void], braking: Array) -> None:
    """Write what depends on the largest decelerations commanded, shape (n, 2), to the table."""
    table["low"], table["high"] = -braking, braking[:, ::-1]
    table["braking"] = braking - table["margin"]
    position = np.where(np.isfinite(table["position"]), np.abs(table["position"]), 0.0)
    v_max, dt = table["v_max"], table["dt"]
    way = v_max * (dt + v_max / table["braking"] + table["braking"] / table["drop"] * dt)
    table["room_tolerance"] = 64.0 * ROUNDING * (position + way)
    table["speed_tolerance"] = 64.0 * ROUNDING * (v_max / dt + table["drop"])


def _largest_braking(name: str, sides: NDArray[np.void]) -> tuple[float, float]:
    """Return the largest decelerations with which a joint can brake, and then turn back in time.

    A joint that comes to rest at a limit just after a step began is accelerated away from it,
    until its acceleration has risen again. With b that of the step, plus what the margin may do,
    this must keep the speed limit and the other position limit.

    Args:
        name: of the joint.
        sides: its upper and lower limit, of `ONE_SIDED_LIMIT`, with all the braking there is.

    Raises:
        JointLimitsError: there are none.
    """
    dt, drop, v_max, w = (float(sides[0][field]) for field in ("dt", "drop", "v_max", "margin"))
    full, exists = (-sides["low"]).tolist(), np.isfinite(sides["position"]).tolist()
    length, (lag, way) = float(sides["position"].sum()), _lag(w, dt, drop)

    def limited(most: float) -> tuple[float, float]:
        up, low = (min(b, most) if there else b for b, there in zip(full, exists, strict=True))
        return up, low

    def fits(most: float, length: float) -> bool:
        pair = limited(most)
        return all(
            b + w <= _fastest(v_max / dt, drop)
            and _reach(b + w, 0.0, dt, drop, other - w)[0]
            <= length - way - _reach(2.0 * w, lag, dt, drop, b - w)[0]
            for b, other, there in zip(pair, pair[::-1], exists, strict=True)
            if there
        )

    low, high = w, max(full)
    if fits(high, length):
        return limited(high)
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if fits(middle, (1.0 - _SLACK) * length) else (low, middle)
    if low == w:
        raise JointLimitsError("jerk", name, drop / dt, "must leave the joint some braking")
    return limited(low)


def _lag(w: float, dt: float, drop: float) -> tuple[float, float]:
    """Return by how much accelerating is behind braking that begins 2 w higher, rad/s and rad."""
    steps = np.arange(1.0, ceil(2.0 * w / drop) + 1.0)
    behind = dt * steps * (2.0 * w - drop * (steps - 1.0))  # in speed, when a step ends
    return float(behind.max(initial=0.0)), float(dt * behind.sum())


@njit(cache=True, error_model="numpy")
def _solve(
    q: Array,
    v: Array,
    lowest: Array,
    highest: Array,
    table: NDArray[np.void],
    lower: Array,
    upper: Array,
    viable: NDArray[np.bool_],
) -> None:
    """Write the bounds of states one after the other, each of as many joints as the table."""
    n = len(table)
    for i in range(len(q)):
        above, below = table[i % n, 0], table[i % n, 1]
        bottom = max(highest[i] - above.change, above.low)
        top = min(lowest[i] + above.change, above.high)
        if bottom > top:
            # Back into the limits as the change allows; unknown by more than that: the middle.
            over, under = lowest[i] > above.high, highest[i] < above.low
            bottom = top = bottom if over else top if under else 0.5 * (bottom + top)
        high, keeps_high = _bound_towards(above.position - q[i], v[i], bottom, top, above)
        low, keeps_low = _bound_towards(below.position + q[i], -v[i], -top, -bottom, below)
        low = -low
        if low > high:
            # The limit that can be kept is not given up for one that cannot. If that is neither,
            # the joint stops, as fast as it can: the speed that is left when its acceleration has
            # gone to zero tells in which direction.
            left = v[i] + 0.5 * bottom * abs(bottom) * above.dt / above.drop
            keep_high = left > 0.0 if keeps_high == keeps_low else keeps_high
            low = high = high if keep_high else low
        lower[i], upper[i], viable[i] = low, high, keeps_high and keeps_low


@njit(cache=True, error_model="numpy")
def _bound_towards(
    room: float, v: float, bottom: float, top: float, limit: np.record
) -> tuple[float, bool]:
    """Return the largest acceleration towards a limit that keeps it, and whether one does.

    Args:
        room: distance to the limit, rad; negative outside.
        v: velocity towards it, rad/s.
        bottom: least acceleration that may be commanded, rad/s^2, the result if none keeps it.
        top: largest one, rad/s^2.
        limit: a `ONE_SIDED_LIMIT`.
    """
    dt, drop, braking = limit.dt, limit.drop, limit.braking
    least = bottom + limit.margin
    a = _fastest((limit.v_max - v) / dt, drop)
    reach, _ = _reach(least, v, dt, drop, braking)
    if v > 0.0 and v + dt * least < 0.0:
        reach = v * (v / (-2.0 * least))  # it stops within the step
    keeps = max(reach, 0.0) <= room + limit.room_tolerance and a >= least - limit.speed_tolerance
    a = min(a, top + limit.margin)
    if v > 0.0 and room < 0.5 * dt * v:
        # Stop within the step: eq. (19). Outside, and still leaving: brake.
        a = min(a, -v * (v / (2.0 * room))) if room > 0.0 else least
    else:
        # Convex in a, and with a slope of at least dt^2 / 2: Newton's steps never pass the root.
        for _ in range(_STEPS):
            reach, slope = _reach(a, v, dt, drop, braking)
            change = (reach - room) / slope
            if not (change > 0.0 and a > least):
                break
            a -= change
            if change < _ENOUGH * min(drop, braking):
                break
    a -= limit.margin
    return (a if a > bottom else bottom), keeps


@njit(cache=True, error_model="numpy")
def _fastest(speed: float, drop: float) -> float:
    """Return the largest first acceleration that adds at most a speed until it has gone to zero.

    Args:
        speed: what may be added, in units of the step, rad/s^2; negative if it is to be less.
        drop: by which the acceleration falls in each step, rad/s^2.
    """
    if not speed > 0.0:
        return speed
    steps = max(ceil(sqrt(0.25 + 2.0 * speed / drop) - 0.5), 1.0)
    return speed / steps + 0.5 * drop * (steps - 1.0)


@njit(cache=True, error_model="numpy")
def _reach(a: float, v: float, dt: float, drop: float, braking: float) -> tuple[float, float]:
    """Return how far on a joint is at most when the first step has ended, rad, if it then brakes.

    Args:
        a: acceleration of the first step, rad/s^2.
        v: velocity, rad/s.
        dt: step, s.
        drop: by which the acceleration falls from step to step, down to ``-braking``, rad/s^2.
        braking: rad/s^2.

    Returns:
        The distance, which is convex in `a`, and its derivative, s^2.
    """
    # Steps until the acceleration is -braking, and of these the ones that end before it stops.
    ramp = max(ceil((a + braking) / drop), 1.0)
    k, w = ramp, v + dt * ramp * (a - 0.5 * drop * (ramp - 1.0))
    at = -braking
    if w <= 0.0:
        middle = a / drop + 0.5
        square = middle * middle + 2.0 * v / (drop * dt)
        k = min(max(floor(middle + sqrt(max(square, 0.0))), 1.0), ramp)
        w = max(v + dt * k * (a - 0.5 * drop * (k - 1.0)), 0.0)
        at = max(a - k * drop, -braking)
    time = w / -at if w > 0.0 else 0.0
    reach = dt * k * (v + 0.5 * dt * (a * k - drop * (k - 1.0) * (2.0 * k - 1.0) / 6.0))
    reach += 0.5 * w * time
    slope = dt * k * (0.5 * dt * k + time)
    if k < ramp:
        slope += 0.5 * time * time
    first = dt * (v + 0.5 * dt * a)
    if first > reach:
        return first, 0.5 * dt * dt
    return reach, slope
