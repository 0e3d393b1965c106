# SPDX-License-Identifier: Apache-2.0
"""Tells within two states that positions and velocities do not belong together.

Of two states that are h apart

    e = q - q0 - h (v0 + v) / 2

is small where accelerations change little in between. What it may be:

- with errors of velocities up to `SHARE` of their limits, h `SHARE` v_max;
- with velocities that are filtered, LAG v' = v_true - v, exactly LAG (v - v0) more;
- after an impact up to h |v - v0| / 2, in either direction.

Most sensors are far better. So it is *learned* for each joint what share of the first two e is,

    share = max |e| / (h `SHARE` v_max + LAG |v - v0|, the latter where e has the sign of v - v0),

and `FACTOR` times this share is the tolerance, once `ENOUGH` states in motion have shown it.
Where e is beyond it the state is *undecided*: an impact, a stamp that came late, or a lie. The
next one decides: over both periods the sum of e must be within what impacts and tolerances
explain. At the onset of a bias b of the velocities e is -h b / 2, which an impact at the very end
of the period gives as well: one state cannot tell them apart. Then the sum is -3 h b / 2, and
h b / 2 may be an impact; after positions have frozen it is -2 h v.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from viability_bounds_pkg.compiled import bound, compiled
from viability_bounds_pkg.state import State

Array = NDArray[np.float64]

LAG = 5e-3
"""Time constant of a filter of the velocities, taken for possible, s."""

FACTOR, LEAST = 3.0, 0.05
"""Tolerance of e as a multiple of the largest seen, and at least as a share of what may be: 0.25%
of the speed limit, and a filter of 0.25 ms."""

ENOUGH = 200
"""States in motion, faster than errors of velocities, after which that tolerance is relied on."""

SLOWLY = 0.02
"""By how much of a larger e the share grows afterwards, so that lies teach little."""

LONGER = 1.5
"""A period so many times the shortest is not compared: torques may have changed within it."""

CALM = 0.2
"""Time after an impact in which another one is believed at once: hands rattle on tables, s."""


class _Seen(NamedTuple):
    """What was seen of e; shapes (n,).

    Attributes:
        share: of good states, the largest as a share of what may be.
        change: of the velocity between good states, the largest, rad/s.
        moved: number of good states in motion.
        e: of the last period, rad.
        room: what an impact and the tolerance explain of it, rad.
    """

    share: Array
    change: Array
    moved: Array
    e: Array
    room: Array


class Agreement:
    """Looks at the joint states of one arm, one after the other.

    Args:
        before: a state, read at each call.
        now: that after it.
        error: of velocities that is taken for possible, shape (n,), rad/s.

    Attributes:
        undecided: whether the last state is.
    """

    def __init__(self, before: State, now: State, error: Array) -> None:
        self._seen = _Seen(*(np.zeros_like(error) for _ in _Seen._fields))
        self._judge = bound(_judge, before, now, error, self._seen, numbers=3)
        self.reset()

    def reset(self) -> None:
        """Begin anew: forget what was learned."""
        for each in self._seen:
            each.fill(0.0)
        self.undecided = False
        self._shortest = math.inf  # time between states, about, s
        self._impact = -math.inf  # time of the last, s

    def contradicts(self, h: float, stamp: float, doubted: bool) -> bool:
        """Return whether positions contradict velocities after all; note what is undecided.

        Args:
            h: time between both states, s.
            stamp: time of the second one, s.
            doubted: whether states are not believed now: these are not learned from.
        """
        second, self.undecided = self.undecided, False
        if h > 0.0:
            self._shortest = min(h, 1.01 * self._shortest)
        if not 0.0 < h <= LONGER * self._shortest:
            return False
        odd, apart = self._judge(h, float(second), float(not doubted))
        if doubted or second or not odd:
            return apart
        self.undecided = apart or stamp > self._impact + CALM
        self._impact = stamp
        return False


@compiled
def _judge(
    before: State,
    now: State,
    error: Array,
    seen: _Seen,
    h: float,
    second: float,
    learns: float,
) -> tuple[bool, bool]:
    """Return whether e is beyond the tolerance, and whether beyond what an impact explains, too.

    Args:
        before: a state.
        now: that after it.
        error: of velocities.
        seen: is kept.
        h: time between both, s.
        second: whether the period before counts as well.
        learns: whether what is within the tolerance is learned from.
    """
    odd = apart = False
    for i in range(error.size):
        v0, v = before.v[i], now.v[i]
        e = now.q[i] - before.q[i] - 0.5 * h * (v0 + v)
        change = abs(v - v0)
        lag = LAG if e * (v - v0) > 0.0 else 0.0
        possible = h * error[i] + lag * change
        begins = seen.moved[i] < ENOUGH
        tolerance = math.inf
        if not begins:
            # Of an acceleration that was not seen yet a filter may make more.
            unseen = lag * max(0.0, change - 2.0 * seen.change[i])
            tolerance = max(LEAST, FACTOR * seen.share[i]) * possible + unseen
        room = 0.5 * h * change + tolerance
        if abs(e) > tolerance:
            odd = True
        elif learns:
            more = max(0.0, abs(e) / possible - seen.share[i])
            new = begins or (lag > 0.0 and change > seen.change[i])
            seen.share[i] += more if new else SLOWLY * more
            seen.change[i] = max(seen.change[i], change)
            seen.moved[i] += abs(v) > error[i]
        if second:
            apart = apart or abs(seen.e[i] + e) > seen.room[i] + room
        else:
            apart = apart or abs(e) > room
        seen.e[i], seen.room[i] = e, room
    return odd, apart
