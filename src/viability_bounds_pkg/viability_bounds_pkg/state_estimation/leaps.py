# SPDX-License-Identifier: Apache-2.0
"""Remembers where positions have leapt, until they have leapt back.

Of two states that are h apart

    e = q - q0 - h (v0 + v) / 2

is beyond what impacts and errors explain where a position *leaps*, as where the
numbers of two joints are exchanged. What agrees with itself afterwards is as wrong as the first
state. So a leap that stays, because the next e is small, has to be undone: by another one, after
which the sum of all e is that of errors and of the way that the arm may have come meanwhile,

    |sum e| <= errors + max |moved| + the way to rest (`way_to_rest`).

While joints are exchanged, one has moved and the number of another has been reported. Where e is
large in the next state, too, it is no leap: velocities lie, or positions have frozen. Nor is it
one where a position was the same to the last bit before and goes on where velocities led
meanwhile: it had frozen, as the arm crept.
"""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from viability_bounds_pkg.state import State

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

STOPS = 0.35
"""How far an arm that is not believed may have moved on, as a multiple of its speed, s."""

UNSURE = 1.0
"""Error of that speed where positions and velocities contradict each other, rad/s."""

ALIKE = 0.25
"""Share of a leap that one back has at least, or the next e of what is no leap."""


class Errors(NamedTuple):
    """What states may differ by from the truth, and how fast joints may be; shapes (n,).

    Attributes:
        position: rad.
        velocity: rad/s.
        quarter_a: a quarter of the largest acceleration, rad/s^2.
        limit: of the speed, rad/s.
        fast: speed for which no velocity is known, rad/s.
    """

    position: Array
    velocity: Array
    quarter_a: Array
    limit: Array
    fast: Array


def free(errors: Errors, h: float) -> Array:
    """Return how far a joint may be off the way between two velocities, shape (n,), rad.

    Light wrists could accelerate a thousand times as much as they do: between two states they come
    no farther than at twice the speed limit.
    """
    between = np.minimum(h * h * errors.quarter_a, h * errors.limit)
    return errors.position + h * errors.velocity + between


def way_to_rest(errors: Errors, v: Array) -> Array:
    """Return how far joints may turn until an arm has stopped itself, shape (n,), rad.

    Each as if it had the same share of its speed limit as the fastest joint: where motors are
    weak, a joint that stood is moved by the others, and one may go on for a while.

    Args:
        errors: of states.
        v: velocity as it begins to stop, shape (n,), rad/s.
    """
    return STOPS * (np.abs(v) / errors.limit).max() * errors.limit


class _Is(IntEnum):
    """What a joint is."""

    CALM = 0
    PENDING = 1
    """It may have leapt: the next state tells."""
    AWAY = 2
    """It has leapt, and not back."""
    LYING = 3
    """Its positions and velocities go on to contradict each other."""


class Leaps:
    """Follows an arm from a doubtful state on, until it is believed.

    Args:
        before: a state, read at each call.
        now: that after it.
        errors: of states.
        with_velocities: whether the velocities of states tell anything.

    Attributes:
        thawed: how far positions that froze untold went at once with the first doubtful state,
            shape (n,), rad.
    """

    def __init__(self, before: State, now: State, errors: Errors, with_velocities: bool) -> None:
        self._before, self._now, self._errors = before, now, errors
        self._with_velocities = with_velocities
        n = errors.position.size
        self._is = np.zeros(n, dtype=int)
        self._still = np.ones(n, dtype=bool)  # the same to the last bit since the first one
        # Sum of all e that are leaps, of the errors of these, and of the way besides, rad.
        self._sum, self._error, self._way, self._size, self.thawed = np.zeros((5, n))
        self.clear()

    def clear(self) -> None:
        """Forget all: the arm is believed, or another one."""
        self._states = 0
        self._is[:] = _Is.CALM
        self._still[:] = True
        for each in (self._sum, self._error, self._way, self._size, self.thawed):
            each.fill(0.0)
        self._pair: list[int] = []  # joints that are exchanged
        self._returned = False  # whether a joint has leapt back
        self._nonsense = False  # whether a state was

    def look(
        self,
        h: float,
        v: Array,
        room: Array | None = None,
        exchanged: tuple[int, int] | None = None,
        frozen: bool = False,
        lies: bool = False,
        went_on: Mask | None = None,
        nonsense: bool = False,
    ) -> None:
        """Look at the next state.

        Args:
            h: time between both states, s.
            v: velocity of the last state that was believed, shape (n,), rad/s.
            room: what good sensors and an impact explain of e, shape (n,), rad; None if unknown.
            exchanged: joints that have exchanged their places; None for none.
            frozen: whether states have frozen.
            lies: whether positions have contradicted velocities for longer than a state or two.
            went_on: positions that froze untold and go on now, as far as can be seen, shape (n,);
                None for none.
            nonsense: whether the next state is beyond all limits.
        """
        (q0, v0), (q1, v1), errors = self._before, self._now, self._errors
        moved = q1 - q0
        if self._with_velocities:
            e = moved - 0.5 * h * (v0 + v1)
            # A joint that turns by its motors, and once more by an impact, seems to go on.
            allowed = free(errors, h) + h * np.maximum(np.abs(v0), np.abs(v1))
            if room is not None:
                allowed = np.minimum(allowed, room)
        else:
            e = moved
            allowed = free(errors, h) + h * errors.fast
        leaps = np.abs(e) > allowed
        self._sum += np.where(leaps, e, 0.0)
        self._error += np.where(leaps, allowed, 0.0)
        self._way += np.where(leaps, 0.0, moved)
        came = np.abs(self._way).max() + way_to_rest(errors, v)
        if not self._with_velocities:
            came += STOPS * UNSURE
        left = np.abs(self._sum) - self._error
        alike, far = np.abs(e) >= ALIKE * self._size, np.abs(e) > errors.position
        back = leaps & ((left <= 0.0) | ((left <= came) & (alike | far)))
        self._states += 1
        if self._states > 2:  # small ones of other joints are not what made it doubtful
            leaps &= far | (self._is != _Is.CALM)
        # Of joints that froze the slow ones leap only as they are seen to move again; the others
        # are as they were to the last bit, which is no leap.
        thaw = self._still & (frozen or bool((self._is == _Is.LYING).any()))
        self._still &= moved == 0.0
        thaw |= moved == 0.0
        if went_on is not None:
            thaw |= went_on
            if self._states == 1:
                self.thawed = np.where(went_on, moved, 0.0)
        if lies:  # what has not leapt before leaps where it ends
            self._is[self._is == _Is.CALM] = _Is.LYING
        calm, pending = self._is == _Is.CALM, self._is == _Is.PENDING
        away = self._is == _Is.AWAY
        returns = bool((away & back).any())
        if not returns:  # else it was too small to be seen at first, and ends with the others
            self._is[calm & leaps] = _Is.PENDING
        self._is[calm & leaps & thaw] = _Is.LYING
        self._is[pending] = _Is.AWAY
        self._is[pending & leaps & alike] = _Is.LYING
        self._is[pending & leaps & (left <= 0.0)] = _Is.CALM
        self._is[away & back] = _Is.CALM
        self._nonsense |= nonsense
        if returns and self._nonsense:
            units = _other_units(self._before, self._now, away & back, errors, h)
            self._is[away & units] = _Is.CALM
        self._returned |= returns or bool((pending & leaps & (left <= 0.0)).any())
        self._size = np.where(calm, np.abs(self._sum), self._size)
        if exchanged is not None:
            joints = list(exchanged)
            # At first they may have been out of range, which told no exchange.
            again = joints == self._pair or bool(
                away[joints].any() and (self._is[joints] == _Is.CALM).all()
            )
            self._is[joints] = _Is.CALM if again else _Is.AWAY
            self._pair = [] if again else joints
            self._returned |= again
        elif self._pair and (self._is[self._pair] == _Is.CALM).any():
            self._is[self._pair] = _Is.CALM  # both, where one alone can be told
            self._pair = []

    @property
    def follows(self) -> bool:
        """Whether there was a doubtful state."""
        return self._states > 0

    @property
    def away(self) -> bool:
        """Whether a joint has leapt, or may have, and not back."""
        return bool(((self._is == _Is.PENDING) | (self._is == _Is.AWAY)).any())

    @property
    def back(self) -> bool:
        """Whether joints have leapt, and all of them back."""
        return self._returned and not self.away

    @property
    def far(self) -> bool:
        """Whether one of these leaps is more than errors of positions, or an exchange."""
        more = np.abs(self._sum) > self._errors.position
        return bool(self._pair) or bool((more & (self._is == _Is.AWAY)).any())


def _other_units(before: State, now: State, known: Mask, errors: Errors, h: float) -> Mask:
    """Return which joints were in other units, as those are `known` to be; shape (n,).

    A joint near zero leaps little as units change, or as they change back, and so is not seen to
    leap back.

    Args:
        before: the last state in other units.
        now: the one after it.
        known: joints that leapt back now, shape (n,).
        errors: of states.
        h: time between both, s.
    """
    q0, (q, v) = before.q, now
    square = float(q[known] @ q[known])
    if square == 0.0:
        return np.zeros_like(known)
    factor = float(q0[known] @ q[known]) / square
    off = np.abs(factor) * (errors.position + h * np.abs(v))
    return np.asarray(np.abs(q0 - factor * q) <= off)
