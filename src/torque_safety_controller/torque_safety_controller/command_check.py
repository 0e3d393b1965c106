# SPDX-License-Identifier: Apache-2.0
"""Detects from measured torque whether commands take effect.

Commands may be lost, late or refused while states go on coming. Then the robot holds the last one,
stops itself, or obeys another controller, and what differs from the commanded motion is no
disturbance: nothing is to be learned from it.
"""

from __future__ import annotations

import numpy as np
from numba import njit
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
        self._tolerance = tolerance
        self._sent = np.zeros((reach, tolerance.size))
        _within(tolerance, self._sent, tolerance)  # compiled before states come
        self.times = 0
        self.reset()

    def reset(self) -> None:
        """Forget all commands."""
        self._count = self._agreed = self._in_row = 0

    @property
    def ignored(self) -> bool:
        """Whether the commands do not act."""
        return self._in_row >= IGNORED_AFTER

    def sent(self, tau: Array) -> None:
        """Record the command that answers a state, shape (n,), N m."""
        if self._count == 0:
            self._sent[:] = tau
        self._sent[self._count % len(self._sent)] = tau
        self._count += 1

    def agrees(self, effort: Array) -> bool:
        """Return whether a torque agrees with the commands, or it is not known yet whether it may.

        Args:
            effort: reported, shape (n,), N m.
        """
        if self._count == 0:
            return True
        if _within(effort, self._sent, self._tolerance):
            self._agreed += 1
            self._in_row = 0
            return True
        if self._agreed < TRUSTED_AFTER:
            self._agreed = 0
            return True
        self._in_row += 1
        self.times += self._in_row == IGNORED_AFTER
        return False


@njit(cache=True)
def _within(effort: Array, sent: Array, tolerance: Array) -> bool:
    """Return whether torques, shape (n,), are in the range of others, shape (k, n)."""
    for j in range(effort.size):
        low, high = sent[:, j].min() - tolerance[j], sent[:, j].max() + tolerance[j]
        if not low <= effort[j] <= high:
            return False
    return True
