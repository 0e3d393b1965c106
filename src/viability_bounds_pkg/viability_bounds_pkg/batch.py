# SPDX-License-Identifier: Apache-2.0
"""The acceleration bounds of many states at once, on arrays of NumPy, PyTorch or JAX.

For training policies in a simulation of thousands of arms: the bounds of `viability`, without a
loop over states or joints, where the states are, a GPU included. The arrays must follow the Python
array API standard, or be known to array-api-compat, which names differences of libraries.

The equations are those of `bounds/kernel.py`, with a choice between values for each of its
branches. `docs/theory/bounds.md` derives them.
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
from array_api_compat import array_namespace, device

from viability_bounds_pkg.bounds.kernel import ONE_SIDED_LIMIT, AccelerationBounds
from viability_bounds_pkg.joint_limits import ROUNDING, JointLimits, JointLimitsError
from viability_bounds_pkg.viability import BoundsSolver

Array = Any
"""An array of any of these libraries."""


def acceleration_bounds(
    q: Array, v: Array, limits: JointLimits, dt: float, **options: Any
) -> AccelerationBounds:
    """Return the acceleration bounds of states of any shape (..., n).

    A function for `bounds(BoundsSolver(limits, dt, **options), q, v)`. In a loop, make the solver
    once, as it checks limits and margins.

    Args:
        q: shape (..., n), rad.
        v: same shape, type and device, rad/s.
        limits: of n joints.
        dt: step, s.
        **options: `margin`, `period`, `position_error` and `velocity_error` of `BoundsSolver`.

    Raises:
        JointLimitsError: an argument is unusable, or the shapes do not fit.
    """
    return bounds(BoundsSolver(limits, dt, **options), q, v)


def bounds(solver: BoundsSolver, q: Array, v: Array) -> AccelerationBounds:
    """Return the bounds of states of any shape (..., n) by a solver, as `solver.bounds` does.

    Args:
        solver: of n joints, with its margins.
        q: shape (..., n), rad.
        v: same shape, type and device, rad/s.

    Returns:
        Arrays of the shape, type and device of `q`. In float64 they are those of the solver; in
        float32 limits are kept up to the rounding of float32.

    Raises:
        JointLimitsError: the shapes differ, or do not fit the number of joints.
    """
    xp = array_namespace(q, v)
    n = len(solver.limits)
    if q.shape != v.shape or q.shape[-1:] != (n,):
        shapes = f"with q of shape {tuple(q.shape)} and v of shape {tuple(v.shape)}"
        raise JointLimitsError("state", None, shapes, f"both must have shape (..., {n})")
    names = ONE_SIDED_LIMIT.names or ()
    table = np.stack([solver.table[name] for name in names])
    table = xp.asarray(table, dtype=q.dtype, device=device(q))
    above, below = (
        SimpleNamespace(**dict(zip(names, table[..., side], strict=True))) for side in (0, 1)
    )
    room_above, room_below = above.position - q, below.position + q
    curved = bool(solver.table["offset"].any())
    high, keeps_high = _bound_towards(xp, room_above, v, above, curved)
    low, keeps_low = _bound_towards(xp, room_below, -v, below, curved)
    low = -low
    either = _resolve_conflict(xp, room_above, room_below, v, low, high, above)
    slow = xp.abs(v) - above.velocity_error <= above.v_max * (1.0 + ROUNDING)
    lower, upper = xp.where(low > high, either, low), xp.where(low > high, either, high)
    return AccelerationBounds(lower, upper, keeps_high & keeps_low & slow)


def _bound_towards(
    xp: Any, room: Array, v: Array, limit: SimpleNamespace, curved: bool
) -> tuple[Array, Array]:
    """Return the largest acceleration that keeps a limit, and whether it can be kept.

    `limit` has arrays of shape (n,), as `ONE_SIDED_LIMIT` says; `curved`: whether speed limits
    depend on position.
    """
    dt = limit.dt
    fastest = v + limit.velocity_error
    slowest = fastest - 2.0 * limit.velocity_error - ROUNDING * limit.v_max
    budget, to_limit = room - 0.5 * dt * fastest, room + limit.rest
    w = xp.minimum(_end_speed(xp, budget, limit, curved), limit.v_max)
    w = xp.where(budget >= limit.free, limit.v_max, w)
    # Stop within the step: eq. (19). Outside, and still leaving: brake.
    inside = to_limit > 0.0
    stop = -fastest * (fastest / (2.0 * xp.where(inside, to_limit, 1.0)))
    stop = xp.where(inside, stop, limit.low)
    # Outside and on the way back: be on the limit when the step ends.
    left = budget + limit.rest
    back = (2.0 * left / dt - fastest) / dt
    a = xp.where(fastest > 0.0, stop, back)
    # Between the last place of rest and the limit: stand when the step ends.
    a = xp.where(left >= 0.0, -fastest / dt, a)
    a = xp.where(budget >= 0.0, (w - fastest) / dt, a)
    if curved:
        along = _along_speed_limit(xp, room, fastest, limit)
        a = xp.where((limit.offset > 0.0) & (fastest > 0.0), xp.minimum(a, along), a)
    a = a - limit.margin
    # Written so that a NaN becomes `high`.
    a = xp.where(a < limit.high, xp.where(a < limit.low, limit.low, a), limit.high)
    room = room + limit.tolerance
    stops = slowest * (slowest + 2.0 * limit.offset) <= limit.twice_braking * room
    if curved:
        full = slowest * slowest <= limit.twice_full * (room - limit.full_room)
        stops = xp.where(slowest > limit.knee, full, stops)
    return a, xp.where(slowest <= 0.0, room + limit.rest >= 0.0, stops)


def _end_speed(xp: Any, budget: Array, limit: SimpleNamespace, curved: bool) -> Array:
    """Return the largest speed at the end of a step from which the limit can be kept."""
    c = limit.twice_braking * xp.clip(budget, 0.0, limit.free)
    w = c / (limit.k + xp.sqrt(limit.k * limit.k + c))
    if not curved:
        return w
    c = limit.twice_full * xp.clip(budget - limit.full_room, 0.0, limit.free)
    k = 0.25 * limit.twice_full * limit.dt
    return xp.where(w > limit.knee, c / (k + xp.sqrt(k * k + c)), w)


def _along_speed_limit(xp: Any, room: Array, v: Array, limit: SimpleNamespace) -> Array:
    """Return the acceleration with which a joint touches its speed limit within the step."""
    moves = (v > 0.0) & (limit.offset > 0.0)
    c, d = xp.where(moves, limit.offset, 1.0), 0.5 * limit.twice_braking
    v = xp.where(moves, v, 1.0)
    # Neither zero nor infinite, so that its root has a derivative.
    slack = xp.clip(2.0 * d * room - v * (v + 2.0 * c), 1e-30, 1e15) / v
    a = 2.0 * d * v / (slack + 2.0 * (v + c) + xp.sqrt(slack * (slack + 4.0 * c)))
    return xp.where((v - a * limit.dt) * (d - a) <= a * c, -a, xp.inf)


def _resolve_conflict(
    xp: Any,
    room_above: Array,
    room_below: Array,
    v: Array,
    low: Array,
    high: Array,
    limit: SimpleNamespace,
) -> Array:
    """Return the one acceleration to use where the bounds of the two limits contradict."""
    dt, v_max, error = limit.dt, limit.v_max, limit.velocity_error
    direction = xp.where(room_below < 0.5 * dt * (error - v), v - error, v)
    direction = xp.where(room_above < 0.5 * dt * (v + error), v + error, direction)
    brake = (room_above < 0.0) | ((room_below >= 0.0) & (direction > 0.0))
    release = (room_below < 0.0) | (direction < 0.0)
    a = xp.where(brake, low, xp.where(release, high, 0.5 * (low + high)))
    margin = limit.margin + error / dt
    a = xp.maximum(xp.minimum(a, (v_max - v) / dt - margin), (-v_max - v) / dt + margin)
    return xp.clip(a, limit.low, limit.high)
