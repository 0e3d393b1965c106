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

    Args:
        dt: control period, s.
        covered: longest row of states without an answer that the bounds hold for.
        warn: told in words.
    """

    def __init__(self, dt: float, covered: int, warn: Callable[[str], object]) -> None:
        self._dt, self._covered, self._warn = dt, covered, warn
        self._told = False
        self._rows: list[int] = []
        self._periods = 0

    def add(self, row: int) -> None:
        """Count an answer after a row of states without one."""
        if self._told:
            return
        self._rows.append(row)
        self._periods += row + 1
        if self._periods * self._dt < WINDOW:
            return
        if self._rows.count(0) < (1.0 - OFTEN) * len(self._rows):
            self._told = True
            self._warn(self._line())
        self._rows, self._periods = [], 0

    def _line(self) -> str:
        """Return the rate that is kept, and one at which the bounds cover the rows."""
        rate, kept = 1.0 / self._dt, len(self._rows) / self._periods
        longest = sorted(self._rows)[-2:][0]  # but for one accident
        slower = rate / max(math.ceil(1.0 / kept), (longest + 1) / (self._covered + 1))
        return (
            f"keeps {kept * rate:.0f} of {rate:g} Hz here: set rate_hz to {slower:.3g} "
            "(and the robot's)"
        )
