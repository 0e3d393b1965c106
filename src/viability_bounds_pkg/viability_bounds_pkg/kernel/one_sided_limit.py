# SPDX-License-Identifier: Apache-2.0
"""The position limits of joints, upper and lower, as records that compiled code reads by name.

Each limit is seen in the direction of motion towards it, so that the lower one is the mirror
image of the upper: position and velocity change sign, `a_min` and `-a_max` change places.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from sys import float_info
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from viability_bounds_pkg.kernel.discrete_kernel import StoppingCurve

Array = NDArray[np.float64]

_TINY = float_info.min

ONE_SIDED_LIMIT = np.dtype(
    [
        ("position", np.float64),
        ("dt", np.float64),
        ("half_dt", np.float64),
        ("twice_braking", np.float64),
        ("k", np.float64),
        ("k_squared", np.float64),
        ("free", np.float64),
        ("v_max", np.float64),
        ("low", np.float64),
        ("high", np.float64),
        ("margin", np.float64),
        ("velocity_error", np.float64),
        ("tolerance", np.float64),
        ("first", np.int64),
        ("points", np.int64),
        ("period", np.float64),
        ("peak", np.float64),
    ],
    align=True,
)
"""One limit of one joint.

- position: of the limit, rad; the room is ``position - q``, for the lower limit ``position + q``.
- dt, half_dt: step and its half, s.
- twice_braking: 2 B, rad/s^2, where B is the deceleration that the kernel counts on.
- k, k_squared: B dt / 2, rad/s, and its square.
- free: budget ``room - dt v / 2`` from which on only the speed limit counts, rad.
- v_max: speed limit, rad/s.
- low, high: hardest accelerations away from the limit and towards it, rad/s^2.
- margin: acceleration kept back for disturbances, rad/s^2.
- velocity_error: by which a velocity may be higher or lower than it is said to be, rad/s.
- tolerance: room that a state may lack and still count as viable, rad.
- first, points: where its inverse stopping curve begins in `JointTable.curves`, and its length;
  0 points where the stopping curve U is the parabola ``v^2 / (2 B)``.
- period: speed that one step of full braking takes away, rad/s.
- peak: U is the parabola where ``v % period >= peak``, rad/s.
"""

CURVE_POINT = np.dtype([("budget", np.float64), ("speed", np.float64)])
"""A point of an inverse stopping curve: ``dt w / 2 + U(w)``, rad, and the speed w, rad/s."""


class JointTable(NamedTuple):
    """The constants of n joints, as the kernel reads them.

    Attributes:
        limits: `ONE_SIDED_LIMIT`, shape (n, 2): the upper and the lower limit.
        shorter: the same for states in which they contradict; of a shorter step, or as `limits`.
        curves: `CURVE_POINT`, the inverse stopping curves of all limits, one after the other.
    """

    limits: NDArray[np.void]
    shorter: NDArray[np.void]
    curves: NDArray[np.void]


def make_table(
    *,
    dt: ArrayLike,
    position: ArrayLike,
    braking: ArrayLike,
    v_max: ArrayLike,
    low: ArrayLike,
    high: ArrayLike,
    margin: ArrayLike = 0.0,
    velocity_error: ArrayLike = 0.0,
    tolerance: ArrayLike = 0.0,
    curves: Sequence[Sequence[StoppingCurve | None]] = (),
) -> JointTable:
    """Return the table of n joints; all arrays are of shape (n, 2) or broadcast to it.

    Args:
        dt: step, s.
        position: see `ONE_SIDED_LIMIT`, as for those that follow.
        braking: deceleration that the kernel counts on, rad/s^2.
        v_max: rad/s.
        low: rad/s^2.
        high: rad/s^2.
        margin: rad/s^2.
        velocity_error: rad/s.
        tolerance: rad.
        curves: for each joint the stopping curves of its limits in units of the step, None for
            the parabola; parabolas only if empty.
    """
    position = np.array(position, dtype=float, ndmin=2)
    limits = np.zeros(position.shape, dtype=ONE_SIDED_LIMIT)
    limits["position"] = position
    limits["dt"] = dt
    limits["half_dt"] = 0.5 * limits["dt"]
    limits["v_max"], limits["margin"], limits["tolerance"] = v_max, margin, tolerance
    limits["velocity_error"] = velocity_error
    limits["low"], limits["high"] = low, high
    b, speed = np.asarray(braking), limits["v_max"]
    k = b * limits["half_dt"]
    limits["twice_braking"], limits["k"] = 2.0 * b, k
    # Not zero even if dt is tiny, so that no room at all does not make 0 / 0.
    limits["k_squared"] = np.maximum(k * k, _TINY)
    limits["free"] = limits["half_dt"] * speed + 0.5 * speed * speed / b
    points: list[NDArray[np.void]] = [np.zeros(0, dtype=CURVE_POINT)]
    for j, pair in enumerate(curves):
        length = float(position[j].sum())
        for limit, curve in zip(limits[j], pair, strict=True):
            if curve is None or len(curve.speed) < 2 or not math.isfinite(limit["position"]):
                continue
            step = float(limit["dt"])
            points.append(
                _inverse_stopping_curve(curve, float(limit["v_max"]) * step, length, step)
            )
            limit["first"], limit["points"] = sum(map(len, points[:-1])), len(points[-1])
            limit["period"], limit["peak"] = curve.braking / step, curve.peak / step
            room = _room_at_full_speed(limit, curve, float(points[-1]["speed"][-1]))
            limit["free"] = 0.5 * step * limit["v_max"] + room
    return JointTable(limits, limits, np.concatenate(points))


def _inverse_stopping_curve(
    curve: StoppingCurve, v_max: float, length: float, dt: float
) -> NDArray[np.void]:
    """Return the speeds for the room available; the curve is in units of the step, as `v_max`."""
    parts = []
    base = 0.0
    while base <= v_max and (base == 0.0 or curve.room_at(base) <= length):
        part = np.empty(len(curve.speed), dtype=CURVE_POINT)
        speed = base + curve.speed
        whole = round(base / curve.braking)
        room = whole * curve.speed + 0.5 * whole * base + curve.room
        part["speed"], part["budget"] = speed / dt, 0.5 * speed + room
        parts.append(part)
        base += curve.braking
    return np.concatenate(parts)


def _room_at_full_speed(limit: np.record, curve: StoppingCurve, last: float) -> float:
    """Return the room needed at v_max, rad; `last` is the highest speed of the inverse curve."""
    v_max, dt = float(limit["v_max"]), float(limit["dt"])
    if v_max <= last or v_max % limit["period"] >= limit["peak"]:
        return curve.room_at(v_max * dt)
    # Rest as a step ends; v_max is for joints that come back from far outside.
    per_step = 0.5 * float(limit["twice_braking"]) * dt
    steps = math.floor(v_max / per_step)
    rest = v_max - steps * per_step
    return 0.5 * dt * (steps * steps * per_step + rest * (2 * steps + 1))


def highest_speeds(room: Array, limit: np.record, curves: NDArray[np.void]) -> Array:
    """Return the highest viable speed towards a limit, rad/s, where `room` >= 0 is left."""
    speed: Array = np.sqrt(limit["twice_braking"] * np.maximum(room, 0.0))
    v_max = limit["v_max"]
    if limit["points"]:
        curve = curves[limit["first"] : limit["first"] + limit["points"]]
        rooms = curve["budget"] - limit["half_dt"] * curve["speed"]
        curved = np.fmod(speed, limit["period"]) < limit["peak"]
        speed = np.where(curved, np.interp(room, rooms, curve["speed"]), speed)
        speed = np.where(room + limit["half_dt"] * v_max >= limit["free"], v_max, speed)
    return np.minimum(speed, v_max)
