# SPDX-License-Identifier: Apache-2.0
"""Tells when a machine does not keep the control rate, and what to set."""

from __future__ import annotations

import math
from collections.abc import Callable

WINDOW = 2.0
"""Over which answers are counted, s of robot time."""

OFTEN = 0.05
"""Share of answers that come after missed states from which a machine is too slow; fewer are
accidents, however long."""


class KeptRate:
    """Counts states and answers; tells once, in words, when many states are not answered.

    Where no state follows the one before within a period, the robot has another rate: that is
    nothing to tell here.

    Args:
        dt: control period, s.
        covered: longest row of states without an answer that the bounds hold for.
        warn: told in words.
    """

    def __init__(self, dt: float, covered: int, warn: Callable[[str], object]) -> None:
        self._dt, self._covered, self._warn = dt, covered, warn
        self._told = False
        self._begin()

    def _begin(self) -> None:
        self._periods = self._answers = self._late = self._longest = 0

    def add(self, row: int) -> None:
        """Count an answer after a row of states without one."""
        self._periods += row + 1
        self._answers += 1
        self._late += row > 0
        self._longest = max(self._longest, row)
        if self._periods * self._dt >= WINDOW:
            if not self._told and OFTEN * self._answers < self._late < self._answers:
                self._told = True
                self._warn(self._line())
            self._begin()

    def _line(self) -> str:
        rate, share = 1.0 / self._dt, self._answers / self._periods
        slower = rate / math.ceil(1.0 / share)
        line = f"keeps {share * rate:.0f} of {rate:g} Hz here: set rate_hz to {slower:.4g}"
        line += " (and the robot's)"
        if self._longest > self._covered:
            line += f", or missed_deadlines to {self._longest}"
        return line
