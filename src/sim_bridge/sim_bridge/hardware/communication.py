# SPDX-License-Identifier: Apache-2.0
"""The way of a command from controller to drives: missed deadlines and delay."""

from __future__ import annotations

from collections import deque
from typing import Generic, TypeVar

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


class _Lost:
    """Stands for a command that was lost."""


class CommandPath(Generic[Command]):
    """Commands on their way to the drives, one in each control period.

    Each acts `command_delay` periods after the state that it answers. So one that comes late, over
    a network, acts when it would have acted anyhow, as long as that time is not over.

    Args:
        imperfections: which ones there are.

    Attributes:
        missed: number of commands lost on purpose.
        absent: whether none had come for the period that `arriving` was last called for.
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
        # None where no command has come yet.
        self._line: deque[Command | _Lost | None] = deque([None] * given.command_delay)
        self.absent = True

    def arriving(self, sent: Command | None) -> Command | None:
        """Return the command that acts in this period.

        Args:
            sent: the command that has come in it; None if there is none.

        Returns:
            The answer to the state of `command_delay` periods ago; None if there was none, or it
            was lost.
        """
        self._line.append(None if sent is None else self._sent(sent))
        due = self._line.popleft()
        self.absent = due is None
        return None if isinstance(due, _Lost) else due

    def arrives_late(self, sent: Command, periods: int, *, ended: bool) -> bool:
        """Take the answer to a state of an earlier period.

        Args:
            sent: the command.
            periods: how many periods ago, above 0.
            ended: whether `arriving` has been called for this period.

        Returns:
            Whether it can still act; not if it comes for the second time, either.
        """
        k = len(self._line) - periods - ended
        if k < 0 or self._line[k] is not None:
            return False
        self._line[k] = self._sent(sent)
        return True

    def _sent(self, command: Command) -> Command | _Lost:
        """Return a command, or what stands for it if it is lost on the way."""
        missed, out = self._deadlines.next(), self._outages.next()
        if missed or out:
            self.missed += 1
            return _Lost()
        return command
