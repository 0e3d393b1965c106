# SPDX-License-Identifier: Apache-2.0
"""A stream of messages, and the faults that act on it one after the other."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from sim_bridge.faults.fault import Fault, Passage


class FaultyStream:
    """Passes messages of one topic on, with what its faults do to them.

    Args:
        faults: in the order in which they act.
        seed: of the random numbers.

    Attributes:
        touched: on how many messages each kind of fault acted.
    """

    def __init__(self, faults: Sequence[Fault], seed: int) -> None:
        self._faults = faults
        self._rng = np.random.default_rng(seed)
        self._on: set[int] = set()
        self.touched: Counter[str] = Counter()

    @property
    def acting(self) -> list[str]:
        """Kinds of the faults that act now."""
        return [self._faults[k].KIND for k in sorted(self._on)]

    def at(self, t: float) -> list[Passage]:
        """Begin and end faults; return what those that end had held back.

        Args:
            t: time, s of robot time from the first message.
        """
        now = {k for k, fault in enumerate(self._faults) if fault.start <= t < fault.end}
        ended, self._on = self._on - now, now
        return [held for k in sorted(ended) for held in self._faults[k].finish()]

    def passages(self, message: Any) -> list[Passage]:
        """Return what comes of a message: itself, changed perhaps, nothing, or several."""
        passing = [Passage(message)]
        for k in sorted(self._on):
            fault = self._faults[k]
            self.touched[fault.KIND] += len(passing)
            passing = [after for each in passing for after in fault.apply(each, self._rng)]
        return passing
