# SPDX-License-Identifier: Apache-2.0
"""Slows the arm where states stay without an answer, and lets it go on gently."""

from __future__ import annotations

import math

RETURN_TIME = 0.5
"""Until goals have all of their effect again, s of robot time."""

REST_TIME = 1.0
"""In which the arm is to come to rest before it goes on, s: one that is shaken never does."""

HELD = 5
"""Unanswered states in a row in which robots may hold the last command, as they do by default."""

FALL_TIME = 0.02
"""Time constant by which the share falls after a row that was just too long, s."""

_NOTHING = 0.01
"""Share that counts as none."""

_ROUNDING = 0.5
"""Of the time between two states, control periods."""


class RateWatch:
    """Share of the goals by which the arm may move, from the times of the states answered.

    A row of unanswered states that is longer than the bounds cover takes the share to zero: within
    a few `FALL_TIME`, so that torques do not step, if the robot may have held the last command; at
    once if it must have stopped itself. `slow` does so at once, too. When the arm rests the share
    grows to one within `RETURN_TIME`, as the square of the time, because goals far away ask for
    so much that already a small share is a large torque. A state adds a period to it, however many
    were missed. All times are those of the states' stamps: in lockstep nothing depends on the
    machine.

    Args:
        dt: control period, s.
        covered: longest row of unanswered states that the bounds hold for.

    Attributes:
        too_long: number of rows that were longer than covered.
        longest: row of unanswered states so far.
    """

    def __init__(self, dt: float, covered: int) -> None:
        self._dt, self._covered = dt, covered
        self._way = 1.0  # of `RETURN_TIME` that has gone by
        self.too_long = self.longest = 0
        self._why = ""
        self._stopping = 0.0
        self._waits = self._falls = False

    def slow(self, why: str, gently: bool = False) -> None:
        """Take the share to zero.

        Args:
            why: what had gone wrong until now.
            gently: within a few `FALL_TIME`, and not at once.
        """
        if self._way > 0.0:
            self._stopping = 0.0
        self._why, self._falls = why, gently
        if gently:
            self._fall()
        else:
            self._way = 0.0

    def ease(self, elapsed: float | None) -> None:
        """Let the share go down as fast as it grows, for a state: `note` does not add to it."""
        self._way = max(0.0, self._way - (elapsed or 0.0) / RETURN_TIME)
        self.wait()

    def wait(self) -> None:
        """Let the share not grow for a state."""
        self._waits = True

    def note(self, elapsed: float | None, at_rest: bool = True) -> str:
        """Take the time since the last answered state; return what to log, mostly nothing.

        Args:
            elapsed: s; None if there was no such state.
            at_rest: whether the arm has come to rest, where the share is zero.
        """
        waits, self._waits = self._waits, False
        if elapsed is None:
            return ""
        was_slowed = self.slowed
        row = int(elapsed / self._dt + _ROUNDING) - 1
        self.longest = max(self.longest, row)
        if row > self._covered:
            what = f"states in a row without an answer, the bounds cover {self._covered}"
            self.slow(f"too many {what}", gently=row <= HELD)
            self.too_long += 1
            return "" if was_slowed else f"{row} {what}: the arm is slowed"
        if self._falls:
            self._fall()
            return ""
        if self._way == 0.0 and not at_rest and self._stopping < REST_TIME:
            self._stopping += elapsed
        elif not waits:
            self._way = min(1.0, self._way + min(elapsed, self._dt) / RETURN_TIME)
        return "the arm goes on" if was_slowed and not self.slowed else ""

    def _fall(self) -> None:
        self._way *= math.exp(-0.5 * self._dt / FALL_TIME)
        if self.share < _NOTHING:
            self._way, self._falls = 0.0, False

    @property
    def share(self) -> float:
        """From 0, the arm is brought to rest, to 1."""
        return self._way**2

    @property
    def slowed(self) -> bool:
        """Whether the arm is slowed."""
        return self._way < 1.0

    @property
    def trouble(self) -> str:
        """What to report; empty if there is nothing."""
        return f"slowed to {self.share:.0%}: {self._why}" if self.slowed else ""
