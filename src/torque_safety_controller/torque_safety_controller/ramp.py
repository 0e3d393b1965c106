# SPDX-License-Identifier: Apache-2.0
"""Share of the goals by which the arm may move: to zero after a fault, and back once it rests."""

from __future__ import annotations

RISE_TIME = 0.5
"""In which goals get all of their effect back, s of robot time."""

FALL_TIME = 0.05
"""In which they lose it where the robot may still obey, s."""

REST_TIME = 1.0
"""After which an arm that does not come to rest goes on, s: one that is shaken never does."""


class Ramp:
    """Scales goals to zero after a fault, then ramps back once the arm rests.

    The share is the square of a ramp in time: goals far away ask for so much that already a small
    share is a large torque. It falls by all the time that has gone by, and rises by one period
    for each state, however many were missed.

    Args:
        period: of control, s.
    """

    def __init__(self, period: float) -> None:
        self._period = period
        self._ramp, self._falls, self._waited = 1.0, False, 0.0

    @property
    def share(self) -> float:
        """From 0, the arm is brought to rest, to 1."""
        return self._ramp**2

    def fall(self, at_once: bool = False) -> None:
        """Let the share go to zero: at once, or within `FALL_TIME`."""
        if self._ramp > 0.0:
            self._falls, self._waited = True, 0.0
        if at_once:
            self._ramp, self._falls = 0.0, False

    def advance(self, elapsed: float, at_rest: bool, waits: bool = False) -> None:
        """Let the share fall, wait or rise.

        Args:
            elapsed: time since the last state, s.
            at_rest: whether the arm rests; it is waited for where the share is zero.
            waits: whether the share is not to rise.
        """
        if self._falls:
            self._ramp = max(0.0, self._ramp - elapsed / FALL_TIME)
            self._falls = self._ramp > 0.0
        elif self._ramp == 0.0 and not at_rest and self._waited < REST_TIME:
            self._waited += elapsed
        elif not waits:
            self._ramp = min(1.0, self._ramp + min(elapsed, self._period) / RISE_TIME)
