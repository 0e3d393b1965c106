# SPDX-License-Identifier: Apache-2.0
"""Delays and drops commands between controller and drives."""

from __future__ import annotations

from collections import deque
from typing import Generic, TypeVar

import numpy as np

from sim_bridge.hardware import Imperfections, RandomStream

Command = TypeVar("Command")


class _Lost:
    """A command that was lost."""


class CommandPath(Generic[Command]):
    """Delays and drops commands on their way to the drives, one in each control period.

    Each acts `command_delay` periods after the state that it answers. So one that comes late, over
    a network, acts when it would have acted anyhow, as long as that time is not over.

    Args:
        imperfections: which ones there are.

    Attributes:
        missed: number of commands lost on purpose.
        absent: whether none had come for the period that `arriving` was last called for.
    """

    def __init__(self, imperfections: Imperfections) -> None:
        given = self._given = imperfections
        self._missing, self._outages = (
            np.random.default_rng([given.imperfection_seed, stream])
            for stream in (RandomStream.MISSED_DEADLINES, RandomStream.OUTAGES)
        )
        # None where no command has come yet.
        self._queue: deque[Command | _Lost | None] = deque([None] * given.command_delay)
        self._missed_in_row = self._outage_left = self.missed = 0
        self.absent = True

    def arriving(self, sent: Command | None) -> Command | None:
        """Return the command that acts in this period.

        Args:
            sent: the command that has come in it; None if there is none.

        Returns:
            The answer to the state of `command_delay` periods ago; None if there was none, or it
            was lost.
        """
        self._queue.append(None if sent is None else self._send(sent))
        due = self._queue.popleft()
        self.absent = due is None
        return None if isinstance(due, _Lost) else due

    def insert_late(self, sent: Command, periods: int, *, ended: bool) -> bool:
        """Add the answer to a state of an earlier period.

        Args:
            sent: the command.
            periods: how many periods ago, above 0.
            ended: whether `arriving` has been called for this period.

        Returns:
            Whether it can still act; not if it comes for the second time, either.
        """
        k = len(self._queue) - periods - ended
        if k < 0 or self._queue[k] is not None:
            return False
        self._queue[k] = self._send(sent)
        return True

    def _send(self, command: Command) -> Command | _Lost:
        """Return a command, or `_Lost` where it misses its period or falls into an outage."""
        missed, in_outage = self._misses_period(), self._in_outage()
        if not (missed or in_outage):
            return command
        self.missed += 1
        return _Lost()

    def _misses_period(self) -> bool:
        """Return whether the next command misses its period, never too many in a row."""
        given = self._given
        if given.missed_probability == 0.0:
            return False
        drawn = self._missing.random() < given.missed_probability
        missed = drawn and self._missed_in_row < given.missed_in_row
        self._missed_in_row = self._missed_in_row + 1 if missed else 0
        return missed

    def _in_outage(self) -> bool:
        """Return whether the next command falls into an outage, of a length drawn at its start."""
        given = self._given
        if given.outage_probability == 0.0:
            return False
        if self._outage_left == 0 and self._outages.random() < given.outage_probability:
            self._outage_left = 1 + int(self._outages.integers(given.outage_longest))
        inside, self._outage_left = self._outage_left > 0, max(0, self._outage_left - 1)
        return inside
