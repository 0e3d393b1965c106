# SPDX-License-Identifier: Apache-2.0
"""Counts control periods, and how well the machine keeps their rate."""

from __future__ import annotations

import math
import time

from viability_bounds_pkg.recent_values import RecentValues

SLOW_AFTER = 2.0
"""How long the robot runs until the rate that the machine keeps is known, s."""

SLOW = 0.95
"""Share of the control rate below which the machine is too slow."""


class Pace:
    """Control periods that were simulated, and by how many the simulation is late.

    Args:
        rate_hz: control rate, Hz.

    Attributes:
        periods: simulated since the last reset.
    """

    def __init__(self, rate_hz: float) -> None:
        self._rate, self._compared = rate_hz, False
        self.restart()

    def restart(self) -> None:
        """Count anew."""
        self.periods = self._late = 0
        self._ticked_at, self._errors = math.nan, RecentValues()
        self.resume()

    def resume(self) -> None:
        """Measure the rate from now on."""
        self._started_at, self._played = time.monotonic(), self.periods

    def tick(self, paused: bool) -> None:
        """Measure the period that ends, in real time."""
        last, self._ticked_at = self._ticked_at, math.nan if paused else time.monotonic()
        took = self._ticked_at - last
        if math.isfinite(took):
            self._errors.add(abs(took - 1.0 / self._rate))
            # A real robot would have gone on.
            self._late += max(0, round(took * self._rate) - 1)

    def values(self) -> dict[str, float]:
        """Return values for diagnostics."""
        errors = self._errors
        return {
            "periods": self.periods,
            "rate_hz": (self.periods - self._played) / (time.monotonic() - self._started_at),
            "late_periods": self._late,
            "period_error_p50_us": 1e6 * errors.percentile(50),
            "period_error_p99_us": 1e6 * errors.percentile(99),
            "period_error_max_us": 1e6 * errors.largest,
        }

    def too_slow(self) -> str:
        """Return, once after the start, how much slower than it should the machine simulates."""
        asked = self.periods + self._late
        if self._compared or asked <= SLOW_AFTER * self._rate:
            return ""
        self._compared, share = True, self.periods / asked
        if share >= SLOW:
            return ""
        return (
            f"the simulation keeps {share * self._rate:.0f} of {self._rate:g} Hz here: set "
            "rate_hz of all nodes to less than that, or clock to lockstep"
        )
