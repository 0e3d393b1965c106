# SPDX-License-Identifier: Apache-2.0
"""Tells by the torques that the motors report whether the commands act.

Commands may be lost, late or refused while states go on coming. Then the robot holds the last one,
stops itself, or obeys somebody else, and what differs from the commanded motion is no disturbance:
nothing is to be learned from it, and the arm is to go on gently when commands act again.

The torque of a state is that of a command some periods ago: it is compared with the range of the
last ones. An arm that has stopped is asked for little at first, so that what holds it differs
little from the commands: until the arm has gone on the tolerance is smaller, twice what differed
while the commands acted.

Where the torque that does not agree is the same to the last bit as well, states have frozen, and
what is sent moves the arm unseen; or the robot has stopped itself, and its sensors are coarse. In
either case nothing is to be sent, but once in a while, so that it is seen when that has ended.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from viability_bounds_pkg.compiled import bound, compiled

Array = NDArray[np.float64]

ENOUGH = 100
"""States in a row that must agree before one that does not counts: some robots report torques of
other units or places, or zeros."""

IGNORED = 3
"""States in a row that do not agree after which commands count as ignored."""

AGAIN = 0.4
"""Time after which commands are tried again, s."""

_LEAST = 0.1
"""Smaller tolerance, as a share of the usual one, where nothing differed."""

_LEARNS, _FORGETS = 5e-4, 1e-4
"""By how much of a larger difference it grows at a state, so that no arm is slowed for ever by it,
and by how much it shrinks while the commands act."""


class CommandWatch:
    """Compares reported torques with the last commanded ones.

    Args:
        tolerance: what they may differ by, shape (n,), N m.
        reach: number of commands one of which acts at a state.

    Attributes:
        effort: reported torque, shape (n,), N m; to be written before `look`.
        in_row: states that do not agree, since the last one that does.
        doubted: whether commands were ignored, and the arm has not gone on yet.
        times: how often that began.
        ignored_for: for how long torques have not agreed, s.
        stuck: whether torques do not agree and stay the same to the last bit.
        seen: largest difference lately while the commands acted, as a share of the tolerance.
    """

    def __init__(self, tolerance: Array, reach: int) -> None:
        self.effort = np.zeros_like(tolerance)
        self._sent = np.zeros((reach, tolerance.size))
        self._before = np.zeros_like(tolerance)  # `effort` of the last state
        self._look = bound(_look, self.effort, self._before, self._sent, tolerance)
        self._next = self.times = 0
        self.seen = 0.0
        self.reset()

    def reset(self) -> None:
        """Forget all commands."""
        self._agreed, self.ignored_for = 0, 0.0
        self.doubted = self._known = False
        self.retry()

    def retry(self) -> None:
        """Have the next states answered, whatever their torques."""
        self.in_row = self._same = 0
        self.stuck, self._stuck_for = False, 0.0

    @property
    def ignored(self) -> bool:
        """Whether the commands do not act."""
        return self.in_row >= IGNORED

    def look(self, slowed: bool, elapsed: float) -> bool:
        """Return whether `effort` agrees with the commands, or it is not known yet whether it may.

        What is not finite agrees with nothing.

        Args:
            slowed: whether the arm has not gone on yet after something went wrong.
            elapsed: time since the last state, s.
        """
        off, same = self._look()
        if not self._known:
            return True
        self.doubted = self.doubted and slowed
        if off <= (min(1.0, max(_LEAST, 2.0 * self.seen)) if self.doubted else 1.0):
            if not self.doubted:
                self.seen = max((1.0 - _FORGETS) * self.seen, off)
            self._agreed += 1
            self.ignored_for = 0.0
            self.retry()
            return True
        if self._agreed < ENOUGH:
            self._agreed = 0
            return True
        self.seen += _LEARNS * max(0.0, min(off, 1.0) - self.seen)
        self.in_row += 1
        self.ignored_for += elapsed
        self._same = self._same + 1 if same else 0
        self.stuck = self._same >= IGNORED
        self._stuck_for = self._stuck_for + elapsed if self.stuck else 0.0
        if self._stuck_for > AGAIN:
            self.retry()
        if self.ignored and not self.doubted:
            self.doubted = True
            self.times += 1
        return False

    def note(self, tau: Array) -> None:
        """Take the command that answers a state, shape (n,), N m."""
        if not self._known:
            self._sent[:] = tau
            self._known = True
        self._next = (self._next + 1) % len(self._sent)
        self._sent[self._next] = tau


@compiled
def _look(effort: Array, before: Array, sent: Array, tolerance: Array) -> tuple[float, bool]:
    """Return by how much of its tolerance a joint is outside the range of `sent`, shape (m, n).

    And whether all torques are as before.
    """
    most, same = 0.0, True
    for j in range(effort.size):
        low = high = sent[0, j]
        for i in range(1, len(sent)):
            low, high = min(low, sent[i, j]), max(high, sent[i, j])
        off = max(low - effort[j], effort[j] - high) / tolerance[j]
        if not off <= most:
            most = off if off == off else np.inf
        same = same and effort[j] == before[j]
        before[j] = effort[j]
    return most, same
