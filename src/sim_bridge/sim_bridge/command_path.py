# SPDX-License-Identifier: Apache-2.0
"""Delays and drops commands between controller and drives."""

from __future__ import annotations

from typing import Generic, TypeVar

import numpy as np

from sim_bridge.hardware import Imperfections, RandomStream

Command = TypeVar("Command")


class CommandPath(Generic[Command]):
    """Delays and drops commands on their way to the drives, one in each control period.

    Each acts `command_delay` periods after the state that it answers. So one that comes late, over
    a network, acts when it would have acted anyhow, as long as that time is not over.

    Args:
        imperfections: which ones there are.

    Attributes:
        delay: periods after which commands act.
        missed: number of commands lost on purpose.
        absent: whether none had come for the last period.
    """

    def __init__(self, imperfections: Imperfections) -> None:
        given = self._given = imperfections
        self._missing, self._outages = (
            np.random.default_rng([given.imperfection_seed, stream])
            for stream in (RandomStream.MISSED_DEADLINES, RandomStream.OUTAGES)
        )
        # By the number of the period whose state they answer; None for one that was lost.
        self._sent: dict[int, Command | None] = {}
        self._period = 0  # the next one to be simulated
        self.delay = given.command_delay
        self._missed_in_row = self._outage_left = self.missed = 0
        self.absent = True

    def send(self, command: Command, age: int = 0) -> bool:
        """Add a command.

        Args:
            command: that has come.
            age: number of periods from the state that it answers to the next to be simulated.

        Returns:
            Whether it can still act; not if it comes for the second time, either.
        """
        answered = self._period - age
        if age > self.delay or answered in self._sent:
            return False
        missed, in_outage = self._misses_period(), self._in_outage()
        lost = missed or in_outage
        self.missed += lost
        self._sent[answered] = None if lost else command
        return True

    def due(self) -> Command | None:
        """Return the command that acts in the next period; None if it is absent or was lost."""
        answered = self._period - self.delay
        self._period += 1
        self.absent = answered not in self._sent
        return self._sent.pop(answered, None)

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
