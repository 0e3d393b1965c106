# SPDX-License-Identifier: Apache-2.0
"""Detects from measured torque whether commands take effect.

Commands may be lost, late or refused while states go on coming. Then the robot holds the last one,
stops itself, or obeys another controller, and what differs from the commanded motion is no
disturbance: nothing is to be learned from it.
"""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

TRUSTED_AFTER = 100
"""States in a row that must agree before one that does not counts: some robots report torques of
other units or places, or zeros."""

IGNORED_AFTER = 3
"""States in a row that do not agree after which commands count as ignored."""


class CommandCheck:
    """Compares each reported torque with the range of the last commanded ones.

    Args:
        tolerance: what they may differ by, shape (n,), N m; inf to compare nothing.
        reach: number of commands one of which acts at a state.

    Attributes:
        ignored: whether commands do not act.
        times: how often that began.
    """

    def __init__(self, tolerance: Array, reach: int) -> None:
        self._tolerance = tolerance.tolist()
        self._sent: deque[list[float]] = deque(maxlen=reach)
        self.times = 0
        self.reset()

    def reset(self) -> None:
        """Forget all commands."""
        self._sent.clear()
        self._agreed = self._in_row = 0

    @property
    def ignored(self) -> bool:
        """Whether the commands do not act."""
        return self._in_row >= IGNORED_AFTER

    def sent(self, tau: Array) -> None:
        """Record the command that answers a state, shape (n,), N m."""
        self._sent.append(tau.tolist())

    def agrees(self, effort: Array) -> bool:
        """Return whether a torque agrees with the commands, or it is not known yet whether it may.

        Args:
            effort: reported, shape (n,), N m.
        """
        if not self._sent:
            return True
        # Lists are faster than arrays for so few numbers.
        joints = zip(effort.tolist(), self._tolerance, zip(*self._sent, strict=True), strict=True)
        if all(min(sent) - most <= tau <= max(sent) + most for tau, most, sent in joints):
            self._agreed += 1
            self._in_row = 0
            return True
        if self._agreed < TRUSTED_AFTER:
            self._agreed = 0
            return True
        self._in_row += 1
        self.times += self._in_row == IGNORED_AFTER
        return False
