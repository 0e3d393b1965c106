# SPDX-License-Identifier: Apache-2.0
"""Bounds by which an arm goes on gently that was stopped within the margins of a limit.

`docs/stopping.md`, "The controller's part", derives them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from torque_safety_controller.qp import AccelerationRange

Array = NDArray[np.float64]

_STANDS = 1e-9
"""A joint that is slower stands: rounding may be its velocity, rad/s."""

_CREEPS = 1e-5
"""A joint that was stopped may still have such a speed, rad/s: less than 0.1 urad in 10 ms."""

_TIME = 0.02
"""T: in which a joint comes to rest, and back to its bounds, s."""

_PART = 0.25
"""Part of the room to the reserve in which a joint may come to rest; it brakes less on the way."""

_RESERVE = 1e-3
"""Distance from the limit itself within which a joint brakes as its bounds ask, rad."""

_STANDING = 0.012
"""Time in which a joint comes to stand whose speed may be noise, s; or a period."""

_LATE = 3
"""Periods that a command may come late."""

_LEAST = 0.5
"""Acceleration by which a joint sets out for its bounds, at half of the share, rad/s^2."""

_HASTE = 4.0
"""How much sooner a joint leaves the reserve than it returns to its bounds."""


def return_gently(
    bounds: AccelerationRange,
    v: Array,
    room: tuple[Array, Array],
    share: float,
    period: float,
    rough: bool = False,
) -> AccelerationRange:
    """Return bounds that push a joint which stands beyond them by a share only.

    An arm may have been stopped within the margins of a position limit; its bounds then demand to
    be back after two periods, by a jolt. Here such a joint returns with the share: one that is d
    beyond its bounds, which ask for 0.5 d / period^2 and for their margins besides, is asked for

        a = share / (1 - share) max(d / T^2, `_LEAST`) - v / T,    T = `_TIME`,

    and for more within `_RESERVE` of the limit itself; at most for its share of the bounds.

    One that moves towards its limit brakes as its bounds ask, or so that it comes to rest in T and
    in a part of the room to the reserve, if that is less. It need not do more than stand at the
    end of the period, if that leaves it a half of the room to the limit itself: what stiction lets
    slip would choose between a push and none. Where its speed may be noise, the reserve is half as
    wide, 2 T take the place of T, on the way back too, and it need only stand after `_STANDING` or
    within a half of the room, and never earlier than at the end of the period: one count of an
    encoder is no jolt, and an observer sees what pushes.

    Args:
        bounds: of the joints, shape (n,) each, rad/s^2.
        v: their velocities, shape (n,), rad/s.
        room: that is left to the lower and the upper position limit, without margins, shape (n,)
            each, rad.
        share: of what the bounds demand, from 0 to 1.
        period: of control, s.
        rough: whether `v` has noise, for which the bounds have margins; pushes are observed.
    """
    lower, upper = bounds
    speed, stop = np.abs(v), -v / period
    to_reserve = room[0] - _RESERVE, room[1] - _RESERVE
    room_ahead, late = np.where(v > 0.0, room[1], room[0]), _LATE * period * speed
    rest = 0.5 * room_ahead - late
    way = _PART * (room_ahead - (0.5 if rough else 1.0) * _RESERVE) - late
    time = 2.0 * _TIME if rough else _TIME
    with np.errstate(divide="ignore", invalid="ignore"):
        brake = np.where(way > 0.0, np.maximum(speed / time, 0.5 * v * v / way), np.inf)
        in_rest = np.where(rest > 0.0, 0.5 * v * v / rest, np.inf)
    if rough:
        stand = np.minimum(np.maximum(speed / _STANDING, in_rest), speed / period)
    else:
        # Where the bounds leave no choice the joint is beyond what they keep.
        slow = np.where(lower == upper, _CREEPS, _STANDS)
        stand = np.maximum(speed / period, np.where(speed < slow, 0.0, in_rest))
    brake = np.minimum(brake, stand)

    grown = share / (1.0 - share) if share < 1.0 else np.inf
    per_way = 2.0 * (period / _TIME) ** 2
    per_missing = _HASTE / _TIME**2
    up = np.maximum(np.maximum(per_way * lower, _LEAST), -per_missing * to_reserve[0])
    down = np.minimum(np.minimum(per_way * upper, -_LEAST), per_missing * to_reserve[1])
    up = np.minimum(share * lower, grown * up - v / time)
    down = np.maximum(share * upper, grown * down - v / time)
    up = np.maximum(up, np.where(v < 0.0, brake, stop))
    down = np.minimum(down, np.where(v > 0.0, -brake, stop))
    return AccelerationRange(
        np.where(lower > 0.0, np.minimum(up, lower), lower),
        np.where(upper < 0.0, np.maximum(down, upper), upper),
    )
