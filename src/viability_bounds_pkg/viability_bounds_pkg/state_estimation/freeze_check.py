# SPDX-License-Identifier: Apache-2.0
"""Tells joint states that have frozen while their stamps go on.

Velocities that stay the same to the last bit have *frozen*, or they are those of an arm that
stands and whose sensors are too coarse to tell. Where that of a joint at rest has been seen to
change to and fro for `ALIVE` at each state, it is the first; changes by less than `NOISE` do not
count: they are rounding in a simulation, where joints may be equally fast to the last bit, too.
Otherwise it matters when the arm is to move and
positions stay the same, too. With the speed v that they report and the acceleration a that the
motors are to give, both fading within `FADING` for what is not known,

    w' = a + e - w / FADING,  w(0) = v,    m' = w - m / FADING,  m(0) = 0

is how far the arm must have come. What holds it at rest is learned within `LEARNED`: e, from what
is known to disturb it to -a. Friction may hold it: what is left counts as far as its torque is
beyond `FRICTION`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from viability_bounds_pkg.compiled import bound, compiled
from viability_bounds_pkg.state import State

Array = NDArray[np.float64]

FRICTION = 0.05
"""What may hold a joint back, as a share of its torque limit, where nothing compensates it."""

STICTION = 0.15
"""The same where something does."""

LEARNED = 0.1
"""Time constant with which an arm that does not move is taken to be held, s."""

ALIVE, STATES = 1.0, 200
"""How long, in s, and how often at least a joint at rest changes where its last bits are noise."""

NOISE = 1e-9
"""Change of a velocity that is more than rounding, rad/s."""

TURNS = 0.25
"""Share of changes that have another direction than those before, at least: it is noise, and not
a motion that ends."""

REST = 0.01
"""Speed below which a joint is at rest here, rad/s."""

ROW = 3
"""States in a row that are the same where none ever was, and at least for"""

ROW_TIME = 0.01
"""this time, s."""

FADING = 0.2
"""Time constant with which motion that is expected is forgotten, s."""

FROZEN = "frozen: they stay the same to the last bit"
"""What is wrong with such states."""


class Expected(NamedTuple):
    """How an arm moves from a state on.

    Attributes:
        a: acceleration that the motors are to give, shape (n,), rad/s^2.
        friction: that may hold joints, as a share of their torque limits.
        disturbance: error of a that is known, shape (n,), rad/s^2; None for none.
        v: velocity, shape (n,), rad/s; None for that of the state.
    """

    a: Array
    friction: float
    disturbance: Array | None = None
    v: Array | None = None


class _Changes(NamedTuple):
    """Changes of velocities, one after the other, of each joint while it is at rest; shapes (n,).

    Attributes:
        number: how many.
        turns: how many had another direction than the one before.
        last: the last one, rad/s.
        still: number of states in a row with the position of the one before.
        stood: that number at the state before.
        way: by the velocities of the states in that row, rad.
        crept: that way at the state before, rad.
    """

    number: Array
    turns: Array
    last: Array
    still: Array
    stood: Array
    way: Array
    crept: Array


class FreezeCheck:
    """Looks at the joint states of one arm, one after the other.

    Args:
        model: the arm, n joints with one coordinate each.
        tau_max: torque limits, shape (n,), N m.
        allowed: how far the arm may seem to lag behind, shape (n,), rad.
        before: a state, read at each call.
        now: that after it.
        with_velocities: whether the velocities of states tell anything.

    Attributes:
        expected: how the arm moves from the last state on; None if that is not known.
        changing: for how long no state has been as that before it, s.
    """

    def __init__(
        self,
        model: pin.Model,
        tau_max: Array,
        allowed: Array,
        before: State,
        now: State,
        with_velocities: bool,
    ) -> None:
        self._model, self._data = model, model.createData()
        self._tau_max, self._allowed = tau_max, allowed
        self._before, self._now = before, now
        self._changes = _Changes(*(np.zeros_like(tau_max) for _ in _Changes._fields))
        self._note_changes = bound(
            _note_changes, before, now, self._changes, with_velocities, numbers=1
        )
        self.reset()

    def went_on(self) -> NDArray[np.bool_]:
        """Return which positions froze untold, and go on with the last state, shape (n,).

        They were the same to the last bit until then, and are now where velocities led meanwhile,
        as far as errors explain, and a joint that became twice as fast.
        """
        changes, moved = self._changes, self._now.q - self._before.q
        off = np.abs(moved - changes.crept)
        return (changes.stood >= ROW) & (off <= self._allowed + np.abs(changes.crept))

    def reset(self) -> None:
        """Begin anew: any state may come next."""
        self.expected: Expected | None = None
        self.changing = 0.0
        for each in self._changes:
            each.fill(0.0)
        self._alive = False  # whether there is always one
        self._told = False
        self._speed = self._held = np.zeros_like(self._tau_max)
        self._begin()

    def _begin(self) -> None:
        self._row = 0  # states that were the same as those before them, one after the other
        self._row_time = 0.0  # s
        self._way: Array | None = None  # that the arm must have come meanwhile, rad
        self._far = False  # whether that is more than allowed

    def believe(self) -> None:
        """Take what is the same for an arm that stands, after all."""
        if self._told and self._row:
            self._alive = False
        self._told = False
        self._begin()

    def look(self, h: float) -> bool:
        """Return whether states have frozen, once.

        Args:
            h: time between both, s.
        """
        expected, self.expected = self.expected, None
        same, most = self._note_changes(h)
        if not same:
            if self._alive:
                self._alive = self._row <= 1 or self._told
            else:
                self._alive = most >= max(STATES, ALIVE / h)
            self._begin()
            self.changing += h
            return False
        self._row, self._row_time, self.changing = self._row + 1, self._row_time + h, 0.0
        if self._told:
            return False
        if self._alive and self._row >= ROW and self._row_time > ROW_TIME - 0.5 * h:
            self._told = True
        elif expected is None or not np.array_equal(self._now.q, self._before.q):
            self._way = None
        else:
            self._told = self._should_have_moved(expected, h)
        return self._told

    def _should_have_moved(self, expected: Expected, h: float) -> bool:
        """Return whether an arm that is said not to move must have moved since it began so."""
        a, fading = expected.a, math.exp(-h / FADING)
        if self._way is None:
            self._way, self._far = np.zeros_like(a), False
            self._held = self._way if expected.disturbance is None else expected.disturbance
            self._speed = self._before.v.copy() if expected.v is None else expected.v
        net = a + self._held
        self._held = self._held - (1.0 - math.exp(-h / LEARNED)) * net
        torque = np.abs(pin.crba(self._model, self._data, self._before.q) @ net)
        beyond = np.maximum(torque - expected.friction * self._tau_max, 0.0)
        share = np.divide(beyond, torque, out=np.zeros_like(a), where=torque > 0.0)
        self._speed = fading * self._speed + h * share * net
        self._way = fading * self._way + h * self._speed
        far = bool((np.abs(self._way) > self._allowed).any())
        once, self._far = self._far, far
        return far and once  # twice: one state may come late


@compiled
def _note_changes(
    before: State, now: State, changes: _Changes, with_velocities: bool, h: float
) -> tuple[bool, float]:
    """Count how often in a row velocities of joints at rest have changed by noise.

    Returns whether the velocities of all joints are the same, or the positions where velocities
    tell nothing; and the most changes of a joint.
    """
    n, most, same = now.v.size, 0.0, True
    for i in range(n):
        change = now.v[i] - before.v[i] if with_velocities else now.q[i] - before.q[i]
        same = same and change == 0.0
        changes.stood[i] = changes.still[i]
        changes.crept[i] = changes.way[i]
        if now.q[i] == before.q[i]:
            changes.still[i] += 1.0
            changes.way[i] += 0.5 * h * (before.v[i] + now.v[i])
        else:
            changes.still[i] = changes.way[i] = 0.0
    for i in range(n):
        change = now.v[i] - before.v[i]
        if same:
            changes.number[i] = changes.turns[i] = changes.last[i] = 0.0
        elif not with_velocities:
            pass
        elif change == 0.0:
            changes.number[i] = changes.turns[i] = 0.0
        elif abs(change) > NOISE and abs(now.v[i]) < REST:
            changes.number[i] += 1.0
            changes.turns[i] += change * changes.last[i] < 0.0
            changes.last[i] = change
        if changes.turns[i] >= TURNS * changes.number[i]:
            most = max(most, changes.number[i])
    return same, most
