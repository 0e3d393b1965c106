"""Constraints on the joint accelerations beyond their bounds and the torque limits."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np


class Rows(NamedTuple):
    """The constraints ``lower <= G a <= upper``; equal limits make an equation.

    Where the torque limits leave no solution, rows and acceleration bounds give way together,
    as little as possible in the sum of squares. A row may be scaled, with its limits, to say
    how dear it is: a row times 10 gives way as one that costs 100 times as much. Lengths up to
    1e4 are sensible.
    """

    G: np.ndarray
    """Shape (k, n)."""
    lower: np.ndarray
    """Shape (k,); -inf for no limit."""
    upper: np.ndarray
    """Shape (k,), not below `lower`; inf for no limit."""


def stack_rows(parts: Sequence[Rows]) -> Rows | None:
    """Return all rows as one, in order; None without any."""
    parts = [part for part in parts if len(part.G)]
    if len(parts) < 2:
        return parts[0] if parts else None
    return Rows(*(np.concatenate(each) for each in zip(*parts, strict=True)))
