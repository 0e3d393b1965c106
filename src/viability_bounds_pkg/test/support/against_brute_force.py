# SPDX-License-Identifier: Apache-2.0
"""Our bounds beside the brute-force solution: state by state, for tests and for the long run."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple, TypeVar

import brute_force
import numpy as np
from joint_cases import column, horizon, one_joint

from viability_bounds_pkg.viability import acceleration_bounds

EXACT = 1e-6
"""Largest error of a bound, as a part of the acceleration range."""

EDGE = 1e-6
"""Distance from the edge of the kernel within which states are not told apart, see `Extremes`."""

BLOCK = 30
"""Motions solved side by side: what is fastest."""

Outcome = TypeVar("Outcome", bound=tuple)


def merged(outcomes: Iterable[Outcome]) -> Outcome:
    """Return named tuples of numbers as one: counts (int) add up, of measures (float) the most."""
    outcomes = list(outcomes)
    kind = type(outcomes[0])
    parts = zip(*outcomes, strict=True)
    return kind(*(sum(part) if isinstance(part[0], int) else max(part) for part in parts))


class Comparison(NamedTuple):
    """What came of some states.

    Attributes:
        states: how many there were.
        compared: those that are viable, and whose bounds were therefore compared.
        misjudged: those further than `EDGE` from the kernel's edge that we call viable and
            brute force does not, or the other way round.
        undecided: those for which the solver of linear programs gave up.
        difference: largest difference of a bound to either bracket, as a part of the
            acceleration range; -inf if none was compared.
    """

    states: int
    compared: int
    misjudged: int
    undecided: int
    difference: float


def compare(case, q, v) -> Comparison:
    """Compare viability and bounds with problem (4), in states q and v of shape (m,)."""
    return merged(_compare(case, q[rows], v[rows]) for rows in _blocks(len(q)))


def _blocks(count: int) -> list[slice]:
    return [slice(first, first + BLOCK) for first in range(0, count, BLOCK)]


def _compare(case, q, v) -> Comparison:
    bounds = acceleration_bounds(column(q), column(v), one_joint(*case[:5]), case[5])
    lower, upper, viable = (part[:, 0] for part in bounds)
    joint, steps = brute_force.BruteForceJoint(*case), horizon(case)
    brackets = [
        brute_force.extreme_accelerations(joint, q, v, steps, end_at_rest)
        for end_at_rest in (False, True)
    ]
    misjudged = undecided = np.zeros(len(q), dtype=bool)
    both = viable.copy()
    for reference in brackets:
        clear = np.abs(reference.margin) > EDGE
        missing = np.isnan(reference.upper) | np.isnan(reference.lower)
        undecided = undecided | np.isnan(reference.margin) | (clear & viable & missing)
        misjudged = misjudged | (clear & (viable != (reference.margin >= 0.0)))
        both &= ~missing
    difference = max(
        np.abs(ours - theirs)[both].max(initial=-np.inf)
        for reference in brackets
        for ours, theirs in ((lower, reference.lower), (upper, reference.upper))
    )
    counts = (int(part.sum()) for part in (both, misjudged, undecided))
    return Comparison(len(q), *counts, float(difference / (case[4] - case[3])))


class Detour(NamedTuple):
    """How much further than they must joints left that were on their way out.

    Attributes:
        compared: joints for which the least is known.
        undecided: those for which the solver of linear programs gave up.
        further: the most that any went beyond the least, rad; -inf if none was compared.
        share: the same as a part of ``a dt^2``, a the larger of the acceleration limits.
    """

    compared: int
    undecided: int
    further: float
    share: float


NO_DETOUR = Detour(0, 0, -np.inf, -np.inf)


def detour(case, q, v, highest) -> Detour:
    """Compare how far joints went with the least excess over the upper limit, by brute force.

    Args:
        case: the joint.
        q: starts that keep the lower limit, shape (m,).
        v: speeds towards the upper limit there, within their own, shape (m,).
        highest: the furthest that each joint went, shape (m,).
    """
    joint, unit = brute_force.BruteForceJoint(*case), max(-case[3], case[4]) * case[5] ** 2
    found = [NO_DETOUR]
    for rows in _blocks(len(q)):
        lower, upper = (
            brute_force.least_excess(joint, q[rows], v[rows], horizon(case), end_at_rest)
            for end_at_rest in (False, True)
        )
        # Bracketed: where the horizon is too short to tell, there is nothing to compare with.
        known = upper - lower <= 1e-6 * unit
        further = (highest[rows] - case[1] - np.maximum(lower, 0.0))[known].max(initial=-np.inf)
        found.append(
            Detour(int(known.sum()), int((~known).sum()), float(further), float(further / unit))
        )
    return merged(found)
