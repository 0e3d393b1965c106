# SPDX-License-Identifier: Apache-2.0
"""Compiled evaluation of the acceleration bounds, joint by joint.

One loop serves a single arm and a batch of a million states. Each position limit is seen in the
direction of motion towards it, so that the lower one is the mirror image of the upper: position
and velocity change sign, `a_min` and `-a_max` change places.
"""

from __future__ import annotations

from collections.abc import Callable
from math import inf, sqrt
from sys import float_info
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from viability_bounds_pkg.bounds.discrete_time import Margins, without_position_error
from viability_bounds_pkg.joint_limits import ROUNDING, JointLimits, JointLimitsError

Array = NDArray[np.float64]

_TINY = float_info.min
_WITHIN = 1.0 + ROUNDING

_FIELDS = (
    "position", "dt", "twice_braking", "k", "free", "v_max", "low", "high", "margin",
    "velocity_error", "tolerance", "rest", "offset", "knee", "twice_full", "full_room"
)  # fmt: skip
ONE_SIDED_LIMIT = np.dtype([(name, np.float64) for name in _FIELDS], align=True)
"""One position limit of one joint, as compiled code reads it by name.

- position: where a joint comes to rest at the latest, rad; the room is ``position - q``, for the
  lower limit ``position + q``.
- dt: step, s.
- twice_braking: 2 B, rad/s^2, where B is the deceleration that the kernel counts on; 2 d where the
  speed limit depends on position.
- k: B dt / 2 + c, rad/s; not zero even if dt is tiny, so that no room at all does not make 0 / 0.
- free: budget ``room - dt v / 2`` from which on only the speed limit counts, rad.
- v_max: speed limit, rad/s.
- low, high: hardest accelerations away from the limit and towards it, rad/s^2.
- margin: acceleration kept back for disturbances, rad/s^2.
- velocity_error: by which a velocity may be higher or lower than it is said to be, rad/s.
- tolerance: room that a state may lack and still count as viable, rad.

Of the speed limit that depends on position, v (v + 2 c) <= 2 d room:

- rest: distance of the position limit itself from `position`, rad; 0 without.
- offset: c, rad/s; 0 without.
- knee: speed above which d is more than the braking, rad/s. The kernel is
  v^2 <= twice_full (room - full_room) there; inf where it is never.
"""


class AccelerationBounds(NamedTuple):
    """Interval of joint accelerations that keeps the limits.

    Attributes:
        lower: shape of the state, rad/s^2; ``a_min <= lower <= upper <= a_max``.
        upper: shape of the state, rad/s^2.
        viable: shape of the state, bool; False where the joint is outside the kernel, whatever
            the errors of the state, so that a limit is or will be broken whatever is done, and
            the interval brings it back.
    """

    lower: Array
    upper: Array
    viable: NDArray[np.bool_]


def make_table(
    limits: JointLimits, steps: Array, braking: Array, margins: Margins
) -> NDArray[np.void]:
    """Return the limits of n joints, `ONE_SIDED_LIMIT` of shape (n, 2): upper and lower.

    Args:
        limits: of n joints.
        steps: of each joint, shape (n,), s.
        braking: B towards the upper and the lower limit, shape (n, 2), rad/s^2.
        margins: what the bounds must hold for.
    """
    inner = without_position_error(limits, margins.position)
    v_max, d = limits.v_max[:, None], limits.deceleration_limit[:, None]
    c, rest = limits.velocity_offset[:, None], limits.rest_distance[:, None]
    position = np.stack([inner.q_max, -inner.q_min], axis=1) - rest
    near = np.where(c > 0.0, d, braking)
    knee = np.where(braking < near, knee_speed(limits, braking), np.inf)
    table = np.zeros(position.shape, dtype=ONE_SIDED_LIMIT)
    table["position"], table["dt"], table["v_max"] = position, steps[:, None], v_max
    table["low"] = np.stack([limits.a_min, -limits.a_max], axis=1)
    table["high"] = np.stack([limits.a_max, -limits.a_min], axis=1)
    table["margin"] = margins.acceleration[:, None]
    table["velocity_error"] = margins.velocity[:, None]
    table["rest"], table["offset"], table["knee"] = rest, c, knee
    table["twice_full"] = 2.0 * braking
    table["full_room"] = 0.5 * c * np.where(np.isfinite(knee), knee, 0.0) / d
    largest = np.abs(np.where(np.isfinite(position), position, 0.0)).max(axis=1, keepdims=True)
    length = position.sum(axis=1, keepdims=True)
    stopping = 0.5 * v_max * (v_max + 2.0 * c) / near
    stopping = np.where(v_max > knee, 0.5 * v_max * v_max / braking + table["full_room"], stopping)
    rounding = ROUNDING * (largest + np.minimum(stopping, length))
    # A joint counts as inside if it may be.
    table["tolerance"] = rounding + 2.0 * margins.position[:, None]
    table["twice_braking"] = 2.0 * near
    table["k"] = np.maximum(0.5 * near * table["dt"] + c, _TINY)
    table["free"] = 0.5 * table["dt"] * v_max + stopping
    return table


def knee_speed(limits: JointLimits, braking: Array) -> Array:
    """Return the speed above which the speed limit falls faster than a joint can brake.

    Following it takes a deceleration of d v / (v + c).

    Args:
        limits: of n joints.
        braking: towards the upper and the lower limit, shape (n, 2), rad/s^2.

    Returns:
        Shape (n, 2), rad/s; inf where the braking is enough at every speed.
    """
    c, d = limits.velocity_offset[:, None], limits.deceleration_limit[:, None]
    return np.divide(
        braking * c, d - braking, out=np.full_like(braking, np.inf), where=braking < d
    )


def bounds_of_states(
    solve: Callable[..., None], table: NDArray[np.void], *states: ArrayLike
) -> AccelerationBounds:
    """Return the bounds of one state of n joints or of a batch of states.

    Args:
        solve: compiled; takes flat arrays of the states, the table, and arrays to write to.
        table: constants of the joints, shape (n, 2).
        states: positions, velocities, and what else there is, all of shape (n,) or (batch, n).

    Raises:
        JointLimitsError: the shapes differ, or do not fit the number of joints.
    """
    arrays = [np.asarray(each, np.float64) for each in states]
    n, shape, size = len(table), arrays[0].shape, arrays[0].size
    for each in arrays:  # in one line it takes longer
        if each.shape != shape or len(shape) not in (1, 2) or shape[-1] != n:
            shapes = " and ".join(str(each.shape) for each in arrays)
            allowed = f"all must have shape ({n},) or (batch, {n})"
            raise JointLimitsError("state", None, f"of shapes {shapes}", allowed)
    lower, upper, viable = np.empty(size), np.empty(size), np.empty(size, np.bool_)
    if len(shape) == 1:  # to reshape takes longer than to find the bounds of one arm
        solve(*arrays, table, lower, upper, viable)
        return AccelerationBounds(lower, upper, viable)
    solve(*[each.ravel() for each in arrays], table, lower, upper, viable)
    return AccelerationBounds(lower.reshape(shape), upper.reshape(shape), viable.reshape(shape))


@njit(cache=True, error_model="numpy")
def solve(
    q: Array,
    v: Array,
    table: NDArray[np.void],
    lower: Array,
    upper: Array,
    viable: NDArray[np.bool_],
) -> None:
    """Write the bounds of states one after the other, each of as many joints as the table."""
    n = len(table)
    for i in range(len(q)):
        above, below = table[i % n, 0], table[i % n, 1]
        high, keeps_high = _bound_towards(above.position - q[i], v[i], above)
        low, keeps_low = _bound_towards(below.position + q[i], -v[i], below)
        low = -low
        if low > high:
            rooms = above.position - q[i], below.position + q[i]
            low = high = _resolve_conflict(rooms[0], rooms[1], v[i], low, high, above)
        slow = abs(v[i]) - above.velocity_error <= above.v_max * _WITHIN
        lower[i], upper[i], viable[i] = low, high, keeps_high and keeps_low and slow


@njit(cache=True, error_model="numpy")
def _bound_towards(room: float, v: float, limit: np.record) -> tuple[float, bool]:
    """Return the largest acceleration towards a limit that keeps it, and whether it can be kept.

    Args:
        room: distance to the limit, rad; negative outside.
        v: velocity towards it, rad/s; the acceleration is for the highest within its error, what
            is kept for the lowest.
        limit: a `ONE_SIDED_LIMIT`.

    Returns:
        Acceleration, rad/s^2, within those of the limit whatever the state; and whether the
        joint is inside the position limit and can stop before it.
    """
    dt = limit.dt
    v += limit.velocity_error
    # Room that is left if the step ends at rest.
    budget = room - 0.5 * dt * v
    if budget >= limit.free:
        a = (limit.v_max - v) / dt
    elif budget >= 0.0:
        a = (min(_end_speed(budget, limit), limit.v_max) - v) / dt
    elif budget + limit.rest >= 0.0:
        # Between the last place of rest and the limit: stand when the step ends.
        a = -v / dt
    elif v > 0.0:
        # Stop within the step: eq. (19). Outside, and still leaving: brake.
        to_limit = room + limit.rest
        a = -v * (v / (2.0 * to_limit)) if to_limit > 0.0 else limit.low
    else:
        # Outside and on the way back: be on the limit when the step ends.
        a = (2.0 * (budget + limit.rest) / dt - v) / dt
    if limit.offset > 0.0 and v > 0.0:
        a = min(a, _along_speed_limit(room, v, limit))
    a -= limit.margin
    # Written so that a NaN becomes `high`.
    if not a < limit.high:
        a = limit.high
    elif a < limit.low:
        a = limit.low
    room += limit.tolerance
    v -= 2.0 * limit.velocity_error + ROUNDING * limit.v_max
    if v <= 0.0:
        return a, room + limit.rest >= 0.0
    if v > limit.knee:
        return a, v * v <= limit.twice_full * (room - limit.full_room)
    return a, v * (v + 2.0 * limit.offset) <= limit.twice_braking * room


@njit(cache=True, error_model="numpy")
def _end_speed(budget: float, limit: np.record) -> float:
    """Return the largest speed at the end of a step from which the limit can be kept, rad/s.

    It is the largest w with dt w / 2 + w (w + 2 c) / (2 B) <= budget, or where that is above the
    knee with the parabola of full braking.
    """
    c = limit.twice_braking * budget
    w = c / (limit.k + sqrt(limit.k * limit.k + c))
    if w > limit.knee:
        c = limit.twice_full * (budget - limit.full_room)
        k = 0.25 * limit.twice_full * limit.dt
        w = c / (k + sqrt(k * k + c))
    return w


@njit(cache=True, error_model="numpy")
def _along_speed_limit(room: float, v: float, limit: np.record) -> float:
    """Return the acceleration with which a joint touches its speed limit within the step.

    It is inf where the step ends before. For v > 0 and c > 0; of a state beyond the speed limit
    it is the acceleration with which that falls at this speed.
    """
    c, d = limit.offset, 0.5 * limit.twice_braking
    a = curve_braking(room, v, c, d)
    # At the touch the speed is a c / (d - a).
    return -a if (v - a * limit.dt) * (d - a) <= a * c else inf


@njit(cache=True, error_model="numpy")
def curve_braking(room: float, v: float, c: float, d: float) -> float:
    """Return the least constant deceleration that keeps v (v + 2 c) <= 2 d room, rad/s^2.

    Args:
        room: distance to the last place of rest, rad.
        v: speed towards it, above 0, rad/s.
        c: offset of the speed limit, above 0, rad/s.
        d: its deceleration, rad/s^2.
    """
    slack = max(2.0 * d * room - v * (v + 2.0 * c), 0.0) / v
    return 2.0 * d * v / (slack + 2.0 * (v + c) + sqrt(slack * (slack + 4.0 * c)))


@njit(cache=True, error_model="numpy")
def _resolve_conflict(
    room_above: float, room_below: float, v: float, lower: float, upper: float, limit: np.record
) -> float:
    """Return the one acceleration to use where the bounds of the two limits contradict.

    That happens outside the kernel, or by rounding on its edge. The limit that is still kept is
    not given up for the one that is broken: a joint on its way back keeps its speed limit, and
    one that cannot stop in time stops as soon as it can without being thrown against the other
    limit. The broken one is told by the position or, inside, by the direction of motion, that in
    which the joint may have to stop within the step. The result is also clipped to the velocity
    limit; `limit` is the upper one.
    """
    dt, v_max, error = limit.dt, limit.v_max, limit.velocity_error
    direction = v
    if room_above < 0.5 * dt * (v + error):
        direction = v + error
    elif room_below < 0.5 * dt * (error - v):
        direction = v - error
    if room_above < 0.0 or (room_below >= 0.0 and direction > 0.0):
        a = lower
    elif room_below < 0.0 or direction < 0.0:
        a = upper
    else:
        a = 0.5 * (lower + upper)
    margin = limit.margin + error / dt
    a = max(min(a, (v_max - v) / dt - margin), (-v_max - v) / dt + margin)
    clipped: float = max(min(a, limit.high), limit.low)
    return clipped
