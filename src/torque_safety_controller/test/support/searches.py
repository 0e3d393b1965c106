# SPDX-License-Identifier: Apache-2.0
"""Searches that are run to their end at once."""

from typing import TypeVar

from torque_safety_controller.tasks.way_search import Search

Found = TypeVar("Found")


def finished(search: Search[Found]) -> tuple[Found, int]:
    """Return what a search found, and its cost."""
    cost = 0
    while True:
        try:
            cost += next(search)
        except StopIteration as found:
            return found.value, cost
