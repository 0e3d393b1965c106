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
        unsafe: those of them that we call viable and brute force does not.
        undecided: those for which the solver of linear programs gave up.
        difference: largest difference of a bound to either bracket, as a part of the
            acceleration range; -inf if none was compared.
        excess: the same of bounds that allow more than brute force does.
    """

    states: int
    compared: int
    misjudged: int
    unsafe: int
    undecided: int
    difference: float
    excess: float


def compare(case, q, v, bounds=acceleration_bounds) -> Comparison:
    """Compare viability and bounds with problem (4), in states q and v of shape (m,)."""
    blocks = [slice(first, first + BLOCK) for first in range(0, len(q), BLOCK)]
    return merged(_compare(case, q[rows], v[rows], bounds) for rows in blocks)


def _compare(case, q, v, bounds) -> Comparison:
    found = bounds(column(q), column(v), one_joint(*case[:5]), case[5])
    lower, upper, viable = (part[:, 0] for part in found)
    joint, steps = brute_force.BruteForceJoint(*case), horizon(case)
    brackets = [
        brute_force.extreme_accelerations(joint, q, v, steps, end_at_rest)
        for end_at_rest in (False, True)
    ]
    misjudged = unsafe = undecided = np.zeros(len(q), dtype=bool)
    both = viable.copy()
    for reference in brackets:
        clear = np.abs(reference.margin) > EDGE
        missing = np.isnan(reference.upper) | np.isnan(reference.lower)
        undecided = undecided | np.isnan(reference.margin) | (clear & viable & missing)
        wrong = clear & (viable != (reference.margin >= 0.0))
        misjudged, unsafe = misjudged | wrong, unsafe | (wrong & viable)
        both &= ~missing
    more = np.concatenate(
        [
            part[both]
            for reference in brackets
            for part in (upper - reference.upper, reference.lower - lower)
        ]
    ) / (case[4] - case[3])
    counts = (int(part.sum()) for part in (both, misjudged, unsafe, undecided))
    largest = (float(part.max(initial=-np.inf)) for part in (np.abs(more), more))
    return Comparison(len(q), *counts, *largest)
