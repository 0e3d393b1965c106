# SPDX-License-Identifier: Apache-2.0
"""Tells when a robot's commands stop and when they are back, each once."""

from __future__ import annotations


class CommandOutage:
    """Counts the periods that a robot brakes because its commands have stopped.

    On a busy machine commands stop and return many times a second: all of that is one outage.

    Args:
        timeout: periods without a command until the robot brakes.
        steady: periods under commands after which these count as back.
    """

    def __init__(self, timeout: int, steady: int) -> None:
        self._timeout, self._steady = timeout, steady
        self._commanded = False
        self._braked = self._good = 0

    def count(self, braked: bool) -> str:
        """Count a period; return what to log, empty if there is nothing new.

        Periods before the first command do not count.
        """
        if not braked:
            self._commanded = True
            self._good += 1
            if self._braked and self._good == self._steady:
                periods, self._braked = self._braked, 0
                return f"commands are back; the robot braked for {periods} periods"
        elif self._commanded:
            self._good = 0
            self._braked += 1
            if self._braked == 1:
                return f"no command for {self._timeout + 1} periods: braking until they are back"
        return ""
