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
h b / 2 may be an impact; after positions have frozen it is -2 h v. Where a clock is set by d the
e of all joints are -d v, once: the next one is within its tolerance.

Where two joints meet and their numbers are *exchanged*, i for j, positions leap nowhere, and
velocities change as in an impact. This is told at once: both velocities change by more than ever
within a period, or both e are beyond their tolerances, except that v_i follows v_j0 and v_j
follows v_i0 as closely as always, and so do the positions,

    |q_i - q_j0 - h (v_j0 + v_i) / 2| within the tolerance of j, and closer than e of i.

So is an exchange of joints that stand apart, where e of both is more than an impact explains.
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

SHORTER = 0.9
"""By how much the shortest one gets less at a state: one odd stamp blinds for none."""

APART = 0.75
"""Part of a period by which two states are apart at least, where a clock was set."""

CALM = 0.2
"""Time after an impact in which another one is believed at once: hands rattle on tables, s."""

USUAL = 1.5
"""A change of velocity within a period that is more than usual, as a multiple of the largest that
was seen twice in a row: impacts are not."""

ALIKE = 0.25
"""Share of the largest e that may be left where a clock was set."""

CLOSER = 0.25
"""How closely velocities of joints that are exchanged follow those of each other: a share of how
they change otherwise."""


class _Seen(NamedTuple):
    """What was seen of e; shapes (n,).

    Attributes:
        share: of good states, the largest as a share of what may be.
        change: of the velocity between good states, the largest, rad/s.
        moved: number of good states in motion.
        e: of the last period, rad.
        room: what an impact and the tolerance explain of it, rad.
        tolerance: as a share of what may be; infinite as long as nothing is relied on.
        last: acceleration in the last period, rad/s^2.
        usual: the largest one that good states had twice in a row, rad/s^2.
    """

    share: Array
    change: Array
    moved: Array
    e: Array
    room: Array
    tolerance: Array
    last: Array
    usual: Array


class Agreement:
    """Looks at the joint states of one arm, one after the other.

    Args:
        before: a state, read at each call.
        now: that after it.
        error: of velocities that is taken for possible, shape (n,), rad/s.

    Attributes:
        undecided: whether the last state is.
        exchanged: joints that have exchanged their places with it; None for none.
        room: what an impact and the tolerance explain of its e, shape (n,), rad; None if unknown.
        period: the shortest time between states, about, s; inf if unknown.
    """

    def __init__(self, before: State, now: State, error: Array) -> None:
        self._seen = _Seen(*(np.zeros_like(error) for _ in _Seen._fields))
        self._judge = bound(_judge, before, now, error, self._seen, numbers=4)
        self.reset()

    def reset(self) -> None:
        """Begin anew: forget what was learned."""
        for each in self._seen:
            each.fill(0.0)
        self.undecided = False
        self.exchanged: tuple[int, int] | None = None
        self.room: Array | None = None
        self.period = math.inf
        self._impact = -math.inf  # time of the last, s
        self._clock = False  # whether it may be that a clock was set

    def forget_lies(self) -> None:
        """Learn anew of joints that may have learned from lies, as states are doubted now.

        Of joints that are not known yet the states before have taught; others have shown more than
        what may be.
        """
        seen = self._seen
        again = (seen.moved < ENOUGH) | (seen.share > 1.0)
        for each in (seen.share, seen.change, seen.moved, seen.usual):
            each[again] = 0.0

    def contradicts(self, h: float, stamp: float, doubted: bool) -> bool:
        """Return whether positions contradict velocities after all; note what is undecided.

        Args:
            h: time between both states, s.
            stamp: time of the second one, s.
            doubted: whether states are not believed now: these are not learned from.
        """
        second, self.undecided = self.undecided, False
        self.exchanged = self.room = None
        if h > 0.0:
            known = math.isfinite(self.period)
            self.period = min(max(h, SHORTER * self.period), 1.01 * self.period) if known else h
        if not 0.0 < h <= LONGER * self.period:
            return False
        odd, apart, clock, i, j = self._judge(h, self.period, float(second), float(not doubted))
        self.room = self._seen.room
        if j > 0:
            self.exchanged = i, j
            return True
        if doubted or second or not odd:
            return apart and not (second and self._clock and not odd)
        self._clock = clock
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
    period: float,
    second: float,
    learns: float,
) -> tuple[bool, bool, bool, int, int]:
    """Return whether e is beyond the tolerance, and whether beyond what an impact explains, too.

    And whether a clock that was set within the period explains it; and the joints i < j that have
    exchanged their places; 0, 0 for none.

    Args:
        before: a state.
        now: that after it.
        error: of velocities.
        seen: is kept.
        h: time between both, s.
        period: the shortest such time, about.
        second: whether the period before counts as well.
        learns: whether what is within the tolerance is learned from.
    """
    odd = apart = off = False
    unusual = 0
    for i in range(error.size):
        v0, v = before.v[i], now.v[i]
        e = now.q[i] - before.q[i] - 0.5 * h * (v0 + v)
        change = abs(v - v0)
        lag = LAG if e * (v - v0) > 0.0 else 0.0
        possible = h * error[i] + lag * change
        begins = seen.moved[i] < ENOUGH
        tolerance = seen.tolerance[i] = math.inf
        if not begins:
            seen.tolerance[i] = max(LEAST, FACTOR * seen.share[i])
            # Of an acceleration that was not seen yet a filter may make more.
            unseen = lag * max(0.0, change - 2.0 * seen.change[i])
            tolerance = seen.tolerance[i] * possible + unseen
        room = 0.5 * h * change + tolerance
        strange = abs(e) > tolerance
        if strange:
            odd = True
        elif learns:
            more = max(0.0, abs(e) / possible - seen.share[i])
            new = begins or (lag > 0.0 and change > seen.change[i])
            seen.share[i] += more if new else SLOWLY * more
            seen.change[i] = max(seen.change[i], change)
            seen.moved[i] += abs(v) > error[i]
            seen.usual[i] = max(seen.usual[i], min(change / h, seen.last[i]))
        seen.last[i] = change / h
        off = off or abs(e) > room
        unusual += strange or ((not begins) and change > USUAL * h * seen.usual[i])
        if second:
            apart = apart or abs(seen.e[i] + e) > seen.room[i] + room
        else:
            apart = apart or abs(e) > room
        seen.e[i], seen.room[i] = e, room
    if off or unusual > 1:
        for j in range(1, error.size):
            for i in range(j):
                if _exchanged(before, now, error, seen, h, i, j):
                    return odd, apart, False, i, j
    return odd, apart, odd and _clock_was_set(before, now, seen, h, period), 0, 0


@compiled
def _clock_was_set(before: State, now: State, seen: _Seen, h: float, period: float) -> bool:
    """Return whether e is -d v for all joints, with h - d about a period.

    A bias of the velocities of an arm that stands gives d = h.
    """
    e_v = v_v = most = 0.0
    for i in range(seen.e.size):
        v = 0.5 * (before.v[i] + now.v[i])
        e_v += seen.e[i] * v
        v_v += v * v
        most = max(most, abs(seen.e[i]))
    if v_v == 0.0 or not APART * period <= h + e_v / v_v <= LONGER * period:
        return False
    fits = True
    for i in range(seen.e.size):
        off = seen.e[i] - e_v / v_v * 0.5 * (before.v[i] + now.v[i])
        fits = fits and abs(off) <= ALIKE * most
    return fits


@compiled
def _exchanged(
    before: State, now: State, error: Array, seen: _Seen, h: float, i: int, j: int
) -> bool:
    """Return whether two states are those of an arm of which two joints are exchanged."""
    # Good sensors tell it; others have shown more than what may be, or nothing yet.
    fits = seen.tolerance[i] <= 1.0 and seen.tolerance[j] <= 1.0
    unusual = off = True
    closer = 0.0
    for k, other in ((i, j), (j, i)):
        own, change = abs(now.v[k] - before.v[k]), now.v[k] - before.v[other]
        r = now.q[k] - before.q[other] - 0.5 * h * (before.v[other] + now.v[k])
        lag = LAG * abs(change) if r * change > 0.0 else 0.0
        fits = fits and abs(r) <= seen.tolerance[other] * (h * error[other] + lag)
        fits = fits and abs(change) <= USUAL * h * seen.usual[other]
        # Torques brake hard, too, but all through the period: e stays small.
        strange = abs(seen.e[k]) > seen.room[k] - 0.5 * h * own
        unusual = unusual and (strange or own > USUAL * h * seen.usual[k])
        unusual = unusual and own > abs(change) / CLOSER
        off = off and abs(seen.e[k]) > seen.room[k]
        closer += abs(seen.e[k]) - abs(r)
    return fits and (unusual or off) and closer > 0.0
