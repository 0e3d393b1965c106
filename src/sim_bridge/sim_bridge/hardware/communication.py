# SPDX-License-Identifier: Apache-2.0
"""The way of a command from controller to drives: missed deadlines and delay."""

from __future__ import annotations

from typing import Generic, TypeVar

from sim_bridge.hardware.delay_line import DelayLine
from sim_bridge.hardware.imperfections import Imperfections
from sim_bridge.hardware.noise import Stream, generator

Command = TypeVar("Command")


class MissedDeadlines:
    """Which commands are lost, at random.

    Args:
        probability: of each, below 1, unless the row would become too long.
        longest_row: how many may be lost in a row.
        seed: of the random numbers.
    """

    def __init__(self, probability: float, longest_row: int, seed: int) -> None:
        self._probability, self._longest = probability, longest_row
        self._random = generator(seed, Stream.MISSED_DEADLINES)
        self._row = 0

    def next(self) -> bool:
        """Return whether the next command is lost."""
        if self._probability == 0.0:
            return False
        drawn = self._random.random() < self._probability
        self._row = self._row + 1 if drawn and self._row < self._longest else 0
        return self._row > 0


class Outages:
    """Times in which all commands are lost, at random.

    Args:
        probability: of each command that one begins with it.
        longest: of their lengths, which are uniform from 1 on, commands.
        seed: of the random numbers.
    """

    def __init__(self, probability: float, longest: int, seed: int) -> None:
        self._probability, self._longest = probability, longest
        self._random = generator(seed, Stream.OUTAGES)
        self._left = 0

    def next(self) -> bool:
        """Return whether the next command is lost."""
        if self._probability == 0.0:
            return False
        if self._left == 0 and self._random.random() < self._probability:
            self._left = 1 + int(self._random.integers(self._longest))
        lost, self._left = self._left > 0, max(0, self._left - 1)
        return lost


class CommandPath(Generic[Command]):
    """Commands on their way to the drives, one in each control period.

    Args:
        imperfections: which ones there are.

    Attributes:
        missed: number of commands lost.
    """

    def __init__(self, imperfections: Imperfections) -> None:
        given = imperfections
        self.missed = 0
        self._deadlines = MissedDeadlines(
            given.missed_probability, given.missed_in_row, given.imperfection_seed
        )
        self._outages = Outages(
            given.outage_probability, given.outage_longest, given.imperfection_seed
        )
        self._line: DelayLine[Command | None] = DelayLine(given.command_delay, None)

    def arriving(self, sent: Command | None) -> Command | None:
        """Return the command that arrives in this period.

        Args:
            sent: the command that was sent in it; None if there is none.

        Returns:
            The one sent `command_delay` periods ago; None if there was none, or it was lost.
        """
        if sent is not None:
            missed, out = self._deadlines.next(), self._outages.next()
            if missed or out:
                self.missed += 1
                sent = None
        return self._line.shift(sent)
