# SPDX-License-Identifier: Apache-2.0
"""Prints how far a scenario has come."""

from __future__ import annotations

import time

_WAIT_SHOWN_AFTER = 10.0  # s


class Progress:
    """Prints a line for each quarter of a scenario, and what it waits for if that lasts.

    Args:
        duration: of the scenario, s of robot time.
    """

    def __init__(self, duration: float) -> None:
        self._duration, self._quarter = duration, 0
        self._reason, self._waiting_since = "", time.monotonic()
        print("waiting for the nodes", flush=True)

    def wait(self, reason: str) -> None:
        """Print why the scenario does not start, if that has lasted for a while."""
        now = time.monotonic()
        if reason != self._reason and now - self._waiting_since > _WAIT_SHOWN_AFTER:
            self._reason, self._waiting_since = reason, now
            print(reason, flush=True)

    def show(self, played: float, state: str) -> None:
        """Print the state of the run when a quarter is over.

        Args:
            played: robot time since the scenario began, s.
            state: in one line.
        """
        if (quarter := int(4.0 * played / self._duration + 1e-6)) > self._quarter:
            self._quarter = quarter
            print(f"{played:6.2f} of {self._duration:g} s  {state}", flush=True)
