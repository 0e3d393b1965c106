# SPDX-License-Identifier: Apache-2.0
"""Shows how far a scenario is, on a terminal or in a log file."""

from __future__ import annotations

import sys
import time

from tqdm import tqdm

_WAIT_SHOWN_AFTER = 10.0
_BAR = "{percentage:3.0f}% |{bar:10}| {n:.2f} of {total:g} s  {desc}"


class Progress:
    """A bar that is rewritten on a terminal; elsewhere a line for each quarter of the scenario.

    Args:
        duration: of the scenario, s of robot time.
    """

    def __init__(self, duration: float) -> None:
        self._duration = duration
        self._quarter = 0
        self._waited_for = ""
        self._waited_since = time.monotonic()
        # With no terminal to draw on there is no bar.
        self._bar = tqdm(
            total=duration, file=sys.stdout, bar_format=_BAR, dynamic_ncols=True, disable=None
        )
        self._print("waiting for the nodes")

    def close(self) -> None:
        """Leave the bar as it is."""
        self._bar.close()

    def wait(self, reason: str) -> None:
        """Show why the scenario has not begun; in a file only a reason that lasts."""
        self._bar.set_description_str(reason)
        now = time.monotonic()
        if reason != self._waited_for and now - self._waited_since > _WAIT_SHOWN_AFTER:
            self._waited_for, self._waited_since = reason, now
            self._print(reason)

    def show(self, played: float, state: str) -> None:
        """Show the state of the run.

        Args:
            played: robot time since the scenario began, s.
            state: in one line.
        """
        self._bar.n = min(played, self._duration)
        self._bar.set_description_str(state)
        if (quarter := int(4.0 * played / self._duration + 1e-6)) > self._quarter:
            self._quarter = quarter
            self._print(f"{played:6.2f} of {self._duration:g} s  {state}")

    def _print(self, line: str) -> None:
        if self._bar.disable:
            print(line, flush=True)
