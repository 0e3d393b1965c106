# SPDX-License-Identifier: Apache-2.0
"""Ways of straight pieces between two postures, searched for bit by bit.

A search is a generator: it yields after each posture that it looked at, so that a control step can
do as much of it as it has time for, and returns what it found.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from math import ceil
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Found = TypeVar("Found")
Search = Generator[int, None, Found]
"""Yields what it did since, in postures looked at."""
Way = list[Array]
"""Postures, each of shape (n,), rad, that straight pieces join."""
CanPass = Callable[[Array], bool]
"""Whether a way may lead through a posture."""

STEP = 0.1
"""Largest motion of a joint between postures that are looked at, rad."""

FREE = 0.4
"""Share of the joints that a random posture moves off the straight way; the others stay on it."""

SHORTCUTS = 60
"""How often a shorter way between two of its points is tried."""


def find_way(
    start: Array,
    goal: Array,
    low: Array,
    high: Array,
    can_pass: CanPass,
    rng: np.random.Generator,
    tries: int,
) -> Search[Way | None]:
    """Search for a way from one posture to another: RRT-Connect, [Kuffner2000].

    A tree of ways grows from each end, until they meet. The straight way is tried first.

    Args:
        start: shape (n,), rad.
        goal: shape (n,), rad.
        low: lowest positions, shape (n,), rad; finite.
        high: highest, shape (n,), rad; finite.
        can_pass: asked at distances of `STEP`, but not of `start`.
        rng: chooses the postures to try.
        tries: how many of them.

    Returns:
        The way with both its ends; None if there is none after these.
    """
    trees: list[list[Way]] = [[[start]], [[goal]]]
    towards = goal
    for k in range(tries):
        reached = yield from _grow(trees[k % 2], towards, can_pass)
        if reached is not None:
            met = yield from _grow(trees[1 - k % 2], reached[-1], can_pass)
            if met is not None and met[-1] is reached[-1]:
                first, last = (reached, met) if k % 2 == 0 else (met, reached)
                return (yield from _shortened([*first, *last[-2::-1]], can_pass, rng))
        towards = start + rng.random() * (goal - start)
        towards = np.where(rng.random(goal.size) < FREE, rng.uniform(low, high), towards)
    return None


def _grow(tree: list[Way], towards: Array, can_pass: CanPass) -> Search[Way | None]:
    """Go on from the nearest end of a way as far as possible; None if that is nowhere."""
    away = np.array([way[-1] for way in tree]) - towards
    nearest = tree[int((away * away).sum(axis=1).argmin())]
    last = yield from _advance(nearest[-1], towards, can_pass)
    if last is nearest[-1]:
        return nearest if last is towards else None
    tree.append([*nearest, last])
    return tree[-1]


def _advance(q: Array, towards: Array, can_pass: CanPass) -> Search[Array]:
    """Return the last posture to pass on the straight way; `towards` itself if that is."""
    count = max(ceil(float(np.abs(towards - q).max()) / STEP), 1)
    last = q
    for k in range(1, count + 1):
        at = towards if k == count else q + (k / count) * (towards - q)
        passed = can_pass(at)
        yield 1
        if not passed:
            break
        last = at
    return last


def _shortened(way: Way, can_pass: CanPass, rng: np.random.Generator) -> Search[Way]:
    """Return a way with straight pieces between random points of it, where they can pass."""
    for _ in range(SHORTCUTS if len(way) > 2 else 0):
        i, j = sorted(rng.integers(len(way) - 1, size=2).tolist())
        a, b = (way[k] + rng.random() * (way[k + 1] - way[k]) for k in (i, j))
        if i < j and (yield from _advance(a, b, can_pass)) is b:
            way = [*way[: i + 1], a, b, *way[j + 1 :]]
    return way
