# SPDX-License-Identifier: Apache-2.0
"""From distances to linear constraints on joint accelerations, compiled.

A distance has a position, a speed and a braking limit, so that it is kept as the lower limit of a
joint is. `docs/guides/collision.md` derives the rows.
"""

from __future__ import annotations

from math import sqrt

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

RESERVE = 0.002
"""Kept on top of the margin for what the linearisation within a step may take, m."""

BRAKING = 2.0
"""Deceleration that a distance counts on at most, m/s^2."""

BRAKING_SHARE = 0.3
"""Share of what the joints can do along a distance that it counts on, up to `BRAKING`."""

RECOVERY_SPEED = 0.1
"""Speed at which bodies inside the margin are parted, m/s."""

SPEED_MAX = 1.0
"""Largest speed of approach, m/s."""

_LEAST_BRAKING = 1e-2  # m/s^2
_LEAST_SHARE = 0.1
_LEVER = 0.1  # m/rad
_ROUNDING = 1e-9


@njit(cache=True)
def write_rows(
    count: int, pair_of: Integers, line: Array, motion: Array, moves: Array, J: Array,
    limits: Array, kept: float, dt: float, speed_max: float, G: Array, lower: Array,
    source: Integers, viable: NDArray[np.bool_],
) -> int:  # fmt: skip
    """Write the rows ``G a >= lower`` that the bounds do not imply; return how many there are.

    Args:
        count: how many distances there are.
        pair_of: see `distances.find_features`, like `line` and `motion`.
        line: likewise.
        motion: likewise.
        moves: 1 for joints that move the first body of a pair only, -1 the second only, shape
            (p, n).
        J: of `distances.move_segments`, shape (n, 6).
        limits: what each joint can brake with, its lower and its upper bound, and what comes on
            top of the accelerations asked for, shape (4, n), rad/s^2.
        kept: distance to be kept, margin and `RESERVE`, m.
        dt: how long an acceleration is held, s.
        speed_max: largest speed of approach, m/s.
        G: written, shape (c, n), m/rad.
        lower: written, shape (c,), m/s^2; never more than some `a` within the bounds reaches.
        source: written: index of the distance, shape (c,), int.
        viable: written, shape (c,); False where the margin is broken, or more braking is needed
            to keep it than is counted on or than the bounds allow.
    """
    k = 0
    for f in range(count):
        brake, most, least, pushed, lever = 0.0, 0.0, 0.0, 0.0, 0.0
        for m in range(len(J)):
            g, sign = 0.0, moves[pair_of[f], m]
            if sign != 0.0:
                for x in range(6):
                    g += sign * line[f, x] * J[m, x]
            G[k, m] = g
            low, high = g * limits[1, m], g * limits[2, m]
            most, least = most + max(low, high), least + min(low, high)
            brake, pushed = brake + abs(g) * limits[0, m], pushed + g * limits[3, m]
            lever = max(lever, abs(g))
        d, rate, bias = motion[f, 0], motion[f, 1], motion[f, 2]
        room = d - kept
        # A bias towards the other body takes from the braking, but falls with the speed squared.
        share = BRAKING_SHARE * brake
        counted = min(BRAKING, share)
        braking = max(min(counted, share + bias), _LEAST_SHARE * counted, _LEAST_BRAKING)
        wanted = max(_least_acceleration(room, rate, braking, dt), (-speed_max - rate) / dt)
        # With which the distance is at its limit after a step. More is never asked for where it
        # approaches its limit or is beyond it, but to end the approach: the last micrometres would
        # be a reason for full braking, which would be a kick, again and again, where nothing but
        # rounding or noise takes a distance there.
        back, stop = -2.0 * (room / dt + rate) / dt, -rate / dt
        if room < 0.0:
            # Where a distance is greatest, levers vanish: the push with them.
            gentle = max(stop, 0.0) + counted * min(1.0, lever / _LEVER)
            wanted = min(wanted, back, gentle, (RECOVERY_SPEED - rate) / dt)
        elif rate < 0.0:
            wanted = min(wanted, max(back, stop))
        wanted -= bias + min(pushed, 0.0)
        if wanted <= least:
            continue
        rounding = _ROUNDING * (1e-3 + abs(most) + abs(least))
        lower[k], source[k] = min(wanted, most - rounding), f
        stops = rate >= 0.0 or rate * rate <= 2.0 * braking * (room + RESERVE)
        viable[k] = room + RESERVE >= 0.0 and stops and wanted <= most + rounding
        k += 1
    return k


@njit(cache=True)
def _least_acceleration(room: float, rate: float, braking: float, dt: float) -> float:
    """Return the least acceleration of a distance with which it can be kept, m/s^2.

    As for the lower limit of a joint, [DelPrete2018]: after the step the distance can still stop
    within the room that it has then.
    """
    budget = room + 0.5 * dt * rate  # of room, if the step ends at rest
    if budget >= 0.0:
        k, square = 0.5 * braking * dt, 2.0 * braking * budget
        return (-square / (k + sqrt(k * k + square)) - rate) / dt
    if rate >= 0.0:  # outside, on the way back: at the limit when the step ends
        return -2.0 * (room / dt + rate) / dt
    return rate * rate / (2.0 * room) if room > 0.0 else np.inf
