"""What one limit of one joint asks for: the formulas behind the bounds, and their constants.

Everything is seen in the direction of motion towards the limit, so that the lower limit is the
upper one in a mirror: position and velocity change sign, `a_min` and `-a_max` change places.
"""

from __future__ import annotations

import math
from sys import float_info
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from viability_bounds_pkg.kernel.discrete_kernel import StoppingCurve

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
        if v_max <= landing.speed[-1] or v_max % landing.period >= landing.peak:
            stopping_room = curve.room_at(v_max * dt)
        else:
            # Rest as a step ends; v_max is for joints that come back from far outside.
            steps = math.floor(v_max / (braking * dt))
            rest = v_max - steps * braking * dt
            stopping_room = 0.5 * dt * (steps * steps * braking * dt + rest * (2 * steps + 1))
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
