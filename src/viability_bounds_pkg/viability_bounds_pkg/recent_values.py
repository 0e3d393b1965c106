# SPDX-License-Identifier: Apache-2.0
"""Percentiles of the newest of many measured values."""

from __future__ import annotations

import math

import numpy as np

_KEPT = 4096


class RecentValues:
    """Keeps the newest 4096 values; their percentiles cost the same however many there were.

    Attributes:
        largest: of all values; NaN without any.
    """

    def __init__(self) -> None:
        self.largest = math.nan
        self._values = np.empty(_KEPT)
        self._count = 0

    def add(self, value: float) -> None:
        """Add a value."""
        self._values[self._count % _KEPT] = value
        self._count += 1
        if not value <= self.largest:
            self.largest = value

    def percentile(self, percent: float) -> float:
        """Return the kept value that this share of them does not exceed; NaN without any."""
        kept = self._values[: self._count].copy()
        if not len(kept):
            return math.nan
        rank = max(0, math.ceil(0.01 * percent * len(kept)) - 1)
        kept.partition(rank)
        return float(kept[rank])
