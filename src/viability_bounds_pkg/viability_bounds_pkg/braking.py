"""What one limit of one joint asks for: the formulas behind the bounds, and their constants.

Everything is seen in the direction of motion towards the limit, so that the lower limit is the
upper one in a mirror: position and velocity change sign, `a_min` and `-a_max` change places.
"""

from __future__ import annotations

from bisect import bisect_right
from math import sqrt
from sys import float_info
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from viability_bounds_pkg.discrete_kernel import StoppingCurve
from viability_bounds_pkg.joint_limits import ROUNDING

Array = NDArray[np.float64]


class Landing(NamedTuple):
    """A stopping curve U that is not a parabola, turned round: speed for the room available.

    Attributes:
        budget: values of ``dt w / 2 + U(w)``, increasing, rad.
        speed: the w that belong to them, rad/s.
        period: speed that one step of full braking takes away, rad/s.
        peak: U is the parabola where ``w % period >= peak``, rad/s.
    """

    budget: list[float]
    speed: list[float]
    period: float
    peak: float


class Side(NamedTuple):
    """One limit of one joint.

    Attributes:
        dt: step, s.
        half_dt: dt / 2, s.
        twice_braking: 2 B, rad/s^2, where B is the deceleration that the kernel counts on.
        k: B dt / 2, rad/s.
        k2: k squared.
        far: budget from which on only the speed limit counts, rad.
        v_max: speed limit, rad/s.
        low: hardest acceleration away from the limit, rad/s^2, negative.
        high: hardest acceleration towards it, rad/s^2.
        margin: acceleration kept back for disturbances, rad/s^2.
        tolerance: room that a state may lack and still count as viable, rad.
        landing: None where U is the parabola ``v^2 / (2 B)``.
    """

    dt: float
    half_dt: float
    twice_braking: float
    k: float
    k2: float
    far: float
    v_max: float
    low: float
    high: float
    margin: float
    tolerance: float
    landing: Landing | None


def make_side(
    *,
    dt: float,
    braking: float,
    v_max: float,
    low: float,
    high: float,
    margin: float,
    tolerance: float,
    length: float,
    curve: StoppingCurve | None,
) -> Side:
    """Return the constants of one limit; `length` is the distance to the opposite one, rad."""
    k = 0.5 * braking * dt
    stopping_room = 0.5 * v_max * v_max / braking
    landing = None
    if curve is not None and len(curve.speed) > 1:
        landing = _make_landing(curve, v_max * dt, length, dt)
        stopping_room = curve.room_at(v_max * dt)
    far = 0.5 * dt * v_max + stopping_room
    # Not zero even if dt is tiny, so that no room at all does not make 0 / 0.
    k2 = max(k * k, float_info.min)
    return Side(
        dt, 0.5 * dt, 2.0 * braking, k, k2, far, v_max, low, high, margin, tolerance, landing
    )


def _make_landing(curve: StoppingCurve, v_max: float, length: float, dt: float) -> Landing:
    """Invert a stopping curve; it, `v_max` and `length` are in units of the step."""
    speeds: list[float] = []
    budgets: list[float] = []
    start = 0.0
    while start <= v_max and (start == 0.0 or curve.room_at(start) <= length):
        speed = start + curve.speed
        whole = round(start / curve.braking)
        room = whole * curve.speed + 0.5 * whole * start + curve.room
        speeds.extend((speed / dt).tolist())
        budgets.extend((0.5 * speed + room).tolist())
        start += curve.braking
    return Landing(budgets, speeds, curve.braking / dt, curve.peak / dt)


def bound_towards(room: float, v: float, side: Side) -> tuple[float, bool]:
    """Return the largest acceleration towards a limit that keeps it, and whether it can be kept.

    Args:
        room: distance to the limit, rad; negative outside.
        v: velocity towards it, rad/s.
        side: the limit.

    Returns:
        Acceleration, rad/s^2, in ``[side.low, side.high]`` whatever the state; and whether the
        joint is inside the position limit and can stop before it.
    """
    dt, half_dt, twice_braking, k, k2, far, v_max, low, high, margin, tolerance, landing = side
    # Room that is left if the step ends at rest.
    budget = room - half_dt * v
    if budget >= far:
        a = (v_max - v) / dt
    elif budget >= 0.0:
        c = twice_braking * budget
        w = c / (k + sqrt(k2 + c))
        if landing is not None:
            w = landing_speed(budget, w, landing)
        a = (w - v) / dt
    elif v > 0.0:
        # Stop within the step: eq. (19). Outside, and still leaving: brake.
        a = -v * (v / (2.0 * room)) if room > 0.0 else low
    else:
        # Outside and on the way back: be on the limit when the step ends.
        a = (2.0 * budget / dt - v) / dt
    a -= margin
    # Written so that a NaN becomes `high`.
    if not a < high:
        a = high
    elif a < low:
        a = low
    room += tolerance
    if v <= 0.0:
        return a, room >= 0.0
    viable = v * v <= twice_braking * room
    if viable and landing is not None:
        budget = min(room + half_dt * v, far)
        c = twice_braking * budget
        reachable = landing_speed(budget, c / (k + sqrt(k2 + c)), landing)
        viable = v <= reachable * (1.0 + ROUNDING)
    return a, viable


def bounds_towards(room: Array, v: Array, side: Side) -> Array:
    """Return the first answer of `bound_towards` for arrays of shape (k,)."""
    budget = v * -side.half_dt
    budget += room
    c = np.minimum(budget, side.far)
    np.maximum(c, 0.0, out=c)
    if side.landing is not None:
        clipped = c.copy()
    c *= side.twice_braking
    w = c + side.k2
    np.sqrt(w, out=w)
    w += side.k
    np.divide(c, w, out=w)
    if side.landing is not None:
        landing_speeds(clipped, w, side.landing)
    np.copyto(w, side.v_max, where=budget >= side.far)
    w -= v
    w /= side.dt
    (over,) = np.nonzero(~(budget >= 0.0))
    if over.size:
        w[over] = _outside(room[over], v[over], budget[over], side)
    w -= side.margin
    # Unlike minimum and maximum, these turn a NaN into a limit.
    np.fmin(w, side.high, out=w)
    return np.fmax(w, side.low, out=w)


def _outside(room: Array, v: Array, budget: Array, side: Side) -> Array:
    stop = np.where(room > 0.0, -v * (v / (2.0 * room)), side.low)
    return np.where(v > 0.0, stop, (2.0 * budget / side.dt - v) / side.dt)


def is_viable_towards(room: float, v: float, side: Side) -> bool:
    """Return whether a state keeps one limit for ever; arguments as `bound_towards`."""
    room += side.tolerance
    if v <= 0.0:
        return room >= 0.0
    if not v * v <= side.twice_braking * room:
        return False
    if side.landing is None:
        return True
    budget = room + side.half_dt * v
    c = side.twice_braking * budget
    return v <= landing_speed(budget, c / (side.k + sqrt(side.k2 + c)), side.landing)


def are_viable_towards(room: Array, v: Array, side: Side) -> NDArray[np.bool_]:
    """Return the second answer of `bound_towards` for arrays of shape (k,)."""
    room = room + side.tolerance
    towards = np.maximum(v, 0.0)
    viable = towards * towards <= side.twice_braking * room
    if side.landing is not None:
        (at,) = np.nonzero(viable & (v > 0.0))
        budget = np.minimum(room[at] + side.half_dt * v[at], side.far)
        c = side.twice_braking * budget
        w = c / (side.k + np.sqrt(side.k2 + c))
        landing_speeds(budget, w, side.landing)
        viable[at] = v[at] <= w * (1.0 + ROUNDING)
    return viable


def highest_speeds(room: Array, side: Side) -> Array:
    """Return the highest viable speed towards a limit, rad/s, where `room` >= 0 is left."""
    speed = np.sqrt(side.twice_braking * np.maximum(room, 0.0))
    if side.landing is not None:
        nodes = np.array(side.landing.speed)
        rooms = np.array(side.landing.budget) - side.half_dt * nodes
        curved = np.fmod(speed, side.landing.period) < side.landing.peak
        speed = np.where(curved, np.interp(room, rooms, nodes), speed)
        fast = room + side.half_dt * side.v_max >= side.far
        speed = np.where(fast, side.v_max, speed)
    return np.minimum(speed, side.v_max)


def landing_speed(budget: float, parabola: float, landing: Landing) -> float:
    """Return the largest end-of-step speed w with ``dt w / 2 + U(w) <= budget``.

    Args:
        budget: room that is left if the step ends at rest, rad, not negative.
        parabola: the answer if U were the parabola, rad/s.
        landing: the stopping curve U.
    """
    if parabola % landing.period >= landing.peak:
        return parabola
    i = bisect_right(landing.budget, budget)
    if i == len(landing.budget):
        # Only from outside: so fast a joint would need more room than there is in the range.
        return landing.speed[-1]
    left, right = landing.budget[i - 1], landing.budget[i]
    low, high = landing.speed[i - 1], landing.speed[i]
    return low + (high - low) * ((budget - left) / (right - left))


def landing_speeds(budget: Array, parabola: Array, landing: Landing) -> None:
    """Do as `landing_speed` for arrays of shape (k,), in place of `parabola`."""
    (at,) = np.nonzero(np.fmod(parabola, landing.period) < landing.peak)
    parabola[at] = np.interp(budget[at], landing.budget, landing.speed)


def settle(above: float, below: float, v: float, lower: float, upper: float) -> float:
    """Return the one acceleration left where the two limits of a joint contradict each other.

    That happens outside the kernel, or by rounding on its edge. The limit that is still kept
    is not given up for the one that is broken: a joint on its way back keeps its speed limit,
    and one that cannot stop in time stops as soon as it can without being thrown against the
    other limit. The broken one is told by the position or, inside, by the direction of motion.

    Args:
        above: room to the upper limit, rad.
        below: room to the lower limit, rad.
        v: velocity, rad/s.
        lower: bound that the lower limit asks for, rad/s^2.
        upper: bound that the upper limit asks for, rad/s^2; below `lower`.
    """
    if above < 0.0 or (below >= 0.0 and v > 0.0):
        return lower
    if below < 0.0 or v < 0.0:
        return upper
    return 0.5 * (lower + upper)


def settle_all(above: Array, below: Array, v: Array, lower: Array, upper: Array) -> Array:
    """Do as `settle` for arrays of shape (k,)."""
    up_is_broken = (above < 0.0) | ((below >= 0.0) & (v > 0.0))
    lo_is_broken = (below < 0.0) | (v < 0.0)
    return np.where(up_is_broken, lower, np.where(lo_is_broken, upper, 0.5 * (lower + upper)))
