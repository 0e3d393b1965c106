# SPDX-License-Identifier: Apache-2.0
"""A delay of whole periods."""

from __future__ import annotations

from collections import deque
from typing import Generic, TypeVar

Item = TypeVar("Item")


class DelayLine(Generic[Item]):
    """Returns what was put in some calls ago.

    Args:
        delay: how many calls; 0 returns each item at once.
        first: what it is filled with.
    """

    def __init__(self, delay: int, first: Item) -> None:
        self._items = deque([first] * delay)

    def shift(self, item: Item) -> Item:
        """Put in `item`; return the one of `delay` calls ago."""
        self._items.append(item)
        return self._items.popleft()
