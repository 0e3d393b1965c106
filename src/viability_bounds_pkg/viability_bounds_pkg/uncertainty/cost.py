# SPDX-License-Identifier: Apache-2.0
"""What declarations cost: speed, range, and time for a move."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from viability_bounds_pkg.uncertainty.declared import DeclaredUncertainty
from viability_bounds_pkg.uncertainty.feasible import declared_names, without
from viability_bounds_pkg.uncertainty.margins import Loop

Array = NDArray[np.float64]


class Reach(NamedTuple):
    """What the bounds leave to n joints; arrays of shape (n,) or (n, 2).

    Attributes:
        braking: deceleration that the bounds count on, towards the upper and the lower limit,
            shape (n, 2), rad/s^2.
        speed: highest speed that is kept, rad/s.
        rest: distance at which joints come to rest before the upper and the lower limit, shape
            (n, 2), rad; 0 without a limit.
        move_time: of a move from rest to rest across half the range, half a turn where there are
            no limits, with the speed and the braking above, s.
    """

    braking: Array
    speed: Array
    rest: Array
    move_time: Array


def reach_of(loop: Loop, declared: DeclaredUncertainty) -> Reach:
    """Return what the bounds leave to the joints where states are reported without errors.

    Args:
        loop: of n joints.
        declared: of these joints.

    Raises:
        JointLimitsError: there are no bounds.
    """
    horizon, position_error, velocity_error, _ = loop.margins(declared)
    table = loop.bounds(declared).table.limits
    w = loop.torque_margins.acceleration + declared.acceleration_disturbance
    braking = 0.5 * table["twice_braking"]
    # Speed that the errors may make of rest, or of the speed kept, by the end of the horizon.
    gained = velocity_error + horizon * w
    rest = (gained**2)[:, None] / (2.0 * braking)
    rest += (position_error + 0.5 * horizon * (velocity_error + gained))[:, None]
    rest += loop.torque_margins.position[:, None]
    rest[~np.isfinite(table["position"])] = 0.0
    speed = table["v_max"][:, 0] - gained
    return Reach(braking, speed, rest, _move_time(loop, speed, braking.min(axis=1)))


def _move_time(loop: Loop, speed: Array, braking: Array) -> Array:
    limits = loop.limits
    distance = 0.5 * (limits.q_max - limits.q_min)
    distance = np.where(np.isfinite(distance), distance, math.pi)
    ramps = 0.5 / np.minimum(-limits.a_min, limits.a_max) + 0.5 / braking
    top = np.minimum(speed, np.sqrt(distance / ramps))
    time: Array = distance / top + ramps * top
    return time


class Share(NamedTuple):
    """What one of the declarations costs, of the joint to which it costs most.

    Attributes:
        name: of the declaration.
        joint: index of the joint.
        speed: highest speed that would be kept without it, more than with it, rad/s.
        rest: distance from the limits that it takes, both sides together, rad.
        move_time: by which it makes the move of `Reach` longer, s.
        weight: speed and rest in shares of the speed limit and of the range.
    """

    name: str
    joint: int
    speed: float
    rest: float
    move_time: float
    weight: float


def shares_of(loop: Loop, declared: DeclaredUncertainty) -> list[Share]:
    """Return what each declaration costs while the others stay, the most expensive first."""
    limits, whole = loop.limits, reach_of(loop, declared)
    shares = []
    for name in declared_names(declared):
        less = reach_of(loop, without(declared, name))
        speed, rest = less.speed - whole.speed, (whole.rest - less.rest).sum(axis=1)
        # Nothing of the range of a continuous joint.
        weight = speed / limits.v_max + rest / (limits.q_max - limits.q_min)
        j = int(np.argmax(weight))
        time = float(whole.move_time[j] - less.move_time[j])
        shares.append(Share(name, j, float(speed[j]), float(rest[j]), time, float(weight[j])))
    return sorted(shares, key=lambda share: -share.weight)
