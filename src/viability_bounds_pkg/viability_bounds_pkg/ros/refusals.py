# SPDX-License-Identifier: Apache-2.0
"""Messages that are not obeyed: counted, and told in few lines at any rate of messages."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable

Warn = Callable[[str], object]

SAME_PERIOD = 1.0
"""Refusals in a row that differ in numbers only get a line this often, s."""


class RefusalLog:
    """Tells refusals, each in a line, but of those that are alike in a row one a second.

    Args:
        warn: told in words.
    """

    def __init__(self, warn: Warn) -> None:
        self._warn = warn
        self._told, self._told_at = "", -math.inf

    def tell(self, text: str) -> None:
        """Tell a refusal, unless one that differs in numbers only has just been told."""
        kind, now = "".join(each for each in text if not each.isdigit()), time.monotonic()
        if kind != self._told or now - self._told_at > SAME_PERIOD:
            self._told, self._told_at = kind, now
            self._warn(text)


def count_refusal(
    topic: str, reason: str, detail: str, refused: Counter[str], warn: Warn | None
) -> None:
    """Count a dropped message by its reason; warn in words of the first one of each reason."""
    refused[reason] += 1
    if warn is not None and refused[reason] == 1:
        warn(f"{topic} refused: {reason}" + (f": {detail}" if detail else ""))


def stamp_fault(stamp: int, now: int, ahead_max: float, late_max: float = math.inf) -> str:
    """Return why a stamp is none of the robot's clock; empty if it may be. Zero stands for now.

    Args:
        stamp: of a message, ns.
        now: stamp of the newest joint state, ns; -1 if there is none.
        ahead_max: how far it may be ahead, s.
        late_max: how long ago it may be, s.
    """
    apart = 1e-9 * (stamp - now)
    if not stamp or now < 0 or -late_max <= apart <= ahead_max:
        return ""
    far, when = abs(apart), "ahead of" if apart > 0.0 else "before"
    by = f"{far:.3g}" if far < 1e3 else f"{far:.0f}"
    of_day = 1e-9 * abs(stamp - time.time_ns())
    clock = ": it is the wall clock's, the robot has another time" if of_day < 0.1 * far else ""
    allowed = min(ahead_max, late_max)
    return (
        f"header.stamp is {by} s {when} that of the joint states{clock}; allowed: {allowed:g} s, "
        "or 0"
    )
