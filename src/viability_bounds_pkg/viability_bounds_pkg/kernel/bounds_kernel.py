# SPDX-License-Identifier: Apache-2.0
"""Compiled evaluation of the acceleration bounds, joint by joint.

One loop serves a single arm and a batch of a million states.
"""

from __future__ import annotations

from math import floor, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from viability_bounds_pkg.compiled import compiled
from viability_bounds_pkg.joint_limits import ROUNDING
from viability_bounds_pkg.kernel.one_sided_limit import JointTable

Array = NDArray[np.float64]

_WITHIN = 1.0 + ROUNDING


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


def solve(q: Array, v: Array, table: JointTable) -> AccelerationBounds:
    """Return the bounds of states of shape (n,) or (batch, n), rad and rad/s."""
    lower, upper = np.empty(q.size), np.empty(q.size)
    viable = np.empty(q.size, dtype=np.bool_)
    if q.ndim == 1:  # to reshape takes longer than to find the bounds of one arm
        _solve(q, v, table.limits, table.shorter, table.curves, lower, upper, viable)
        return AccelerationBounds(lower, upper, viable)
    _solve(q.ravel(), v.ravel(), table.limits, table.shorter, table.curves, lower, upper, viable)
    shape = q.shape
    return AccelerationBounds(lower.reshape(shape), upper.reshape(shape), viable.reshape(shape))


@compiled(error_model="numpy")
def _solve(
    q: Array,
    v: Array,
    limits: NDArray[np.void],
    shorter: NDArray[np.void],
    curves: NDArray[np.void],
    lower: Array,
    upper: Array,
    viable: NDArray[np.bool_],
) -> None:
    """Write the bounds of states one after the other, each of as many joints as `limits`."""
    n = len(limits)
    for first in range(0, len(q), n):
        for j in range(n):
            i = first + j
            low, high, viable[i] = _interval(q[i], v[i], limits[j, 0], limits[j, 1], curves)
            if low > high:  # nothing can be held for the step
                above, below = shorter[j, 0], shorter[j, 1]
                low, high, _ = joint_bounds(q[i], v[i], above, below, curves)
            lower[i], upper[i] = low, high


@compiled(error_model="numpy")
def joint_bounds(
    q: float, v: float, above: np.record, below: np.record, curves: NDArray[np.void]
) -> tuple[float, float, bool]:
    """Return the bounds of one joint state and whether it is in the kernel.

    Args:
        q: rad.
        v: rad/s.
        above: upper limit, a `ONE_SIDED_LIMIT`.
        below: lower limit.
        curves: of `JointTable`.

    Returns:
        Lower and upper bound, rad/s^2, and whether the state is viable.
    """
    low, high, viable = _interval(q, v, above, below, curves)
    if low > high:
        low = high = _resolve_conflict(above.position - q, below.position + q, v, low, high, above)
    return low, high, viable


@compiled(error_model="numpy")
def _interval(
    q: float, v: float, above: np.record, below: np.record, curves: NDArray[np.void]
) -> tuple[float, float, bool]:
    """Return what each limit allows by itself; see `joint_bounds`. It may be no interval."""
    high, keeps_high = _bound_towards(above.position - q, v, above, curves)
    low, keeps_low = _bound_towards(below.position + q, -v, below, curves)
    slow = abs(v) - above.velocity_error <= above.v_max * _WITHIN
    return -low, high, keeps_high and keeps_low and slow


@compiled(error_model="numpy")
def _bound_towards(
    room: float, v: float, limit: np.record, curves: NDArray[np.void]
) -> tuple[float, bool]:
    """Return the largest acceleration towards a limit that keeps it, and whether it can be kept.

    Args:
        room: distance to the limit, rad; negative outside.
        v: velocity towards it, rad/s; the acceleration is for the highest within its error, what
            is kept for the lowest.
        limit: a `ONE_SIDED_LIMIT`.
        curves: of `JointTable`.

    Returns:
        Acceleration, rad/s^2, within those of the limit whatever the state; and whether the
        joint is inside the position limit and can stop before it.
    """
    dt = limit.dt
    v += limit.velocity_error
    # Room that is left if the step ends at rest.
    budget = room - limit.half_dt * v
    if budget >= limit.free:
        a = (limit.v_max - v) / dt
    elif budget >= 0.0:
        a = (min(_end_speed(budget, limit, curves), limit.v_max) - v) / dt
    elif v > 0.0:
        # Stop within the step: eq. (19). Outside, and still leaving: brake.
        a = -v * (v / (2.0 * room)) if room > 0.0 else limit.low
    else:
        # Outside and on the way back: be on the limit when the step ends.
        a = (2.0 * budget / dt - v) / dt
    a -= limit.margin
    # Written so that a NaN becomes `high`.
    if not a < limit.high:
        a = limit.high
    elif a < limit.low:
        a = limit.low
    room += limit.tolerance
    v -= 2.0 * limit.velocity_error
    if v <= 0.0:
        return a, room >= 0.0
    viable = v * v <= limit.twice_braking * room
    if viable and limit.points > 0:
        budget = min(room + limit.half_dt * v, limit.free)
        viable = v <= _end_speed(budget, limit, curves) * _WITHIN
    return a, viable


@compiled(error_model="numpy")
def _end_speed(budget: float, limit: np.record, curves: NDArray[np.void]) -> float:
    """Return the largest end-of-step speed w with ``dt w / 2 + U(w) <= budget``."""
    c = limit.twice_braking * budget
    parabola: float = c / (limit.k + sqrt(limit.k_squared + c))
    if limit.points == 0 or parabola % limit.period >= limit.peak:
        return parabola
    low, end = limit.first, limit.first + limit.points
    high = end
    while low < high:
        middle = (low + high) // 2
        if budget < curves[middle].budget:
            high = middle
        else:
            low = middle + 1
    before = curves[low - 1]
    if low == end:
        # Only from outside: so fast a joint would need more room than there is in the range. To
        # come to rest as a step ends it needs chords of the parabola, one for each step.
        length, per_step = budget / limit.dt, 2.0 * limit.k
        steps = floor(0.5 * (sqrt(1.0 + 8.0 * length / per_step) - 1.0))
        rest = length - 0.5 * per_step * steps * (steps + 1.0)
        braked: float = max(before.speed, per_step * steps + rest / (steps + 1.0))
        return braked
    after = curves[low]
    share = (budget - before.budget) / (after.budget - before.budget)
    speed: float = before.speed + (after.speed - before.speed) * share
    return speed


@compiled(error_model="numpy")
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
    if room_above < limit.half_dt * (v + error):
        direction = v + error
    elif room_below < limit.half_dt * (error - v):
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
