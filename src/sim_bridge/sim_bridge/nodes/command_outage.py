# SPDX-License-Identifier: Apache-2.0
"""Tells when a robot's commands stop and when they are back, each once."""

from __future__ import annotations


class CommandOutage:
    """Counts the periods in which a robot stops or is stopped because its commands do not come.

    On a busy machine commands stop and return many times a second: all of that is one outage.

    Args:
        timeout: periods without a command until the robot stops.
        steady: periods under commands after which these count as back.

    Attributes:
        commanded: whether there has been a command.
    """

    def __init__(self, timeout: int, steady: int) -> None:
        self._timeout, self._steady = timeout, steady
        self.commanded = False
        self._silent = self._good = 0

    def count(self, silent: bool) -> str:
        """Count a period; return what to log, empty if there is nothing new.

        Periods before the first command do not count.
        """
        if not silent:
            self.commanded = True
            self._good += 1
            if self._silent and self._good == self._steady:
                periods, self._silent = self._silent, 0
                return f"commands are back; the robot stopped itself for {periods} periods"
        elif self.commanded:
            self._good = 0
            self._silent += 1
            if self._silent == 1:
                return f"no command for {self._timeout + 1} periods: stopping until they are back"
        return ""
