# SPDX-License-Identifier: Apache-2.0
"""Bounds of limited jerk step by step, with what is known of the last acceleration."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from viability_bounds_pkg.bounds.jerk import JerkBoundsSolver
from viability_bounds_pkg.bounds.kernel import AccelerationBounds

Array = NDArray[np.float64]


class BoundsAfterLast:
    """Bounds that remember between which values the last acceleration was.

    Until it is told, an acceleration may be any within the bounds of its step. Those of the next
    step then hold for all of these: after a lost message they leave little more than the last
    acceleration that is known.

    Args:
        solver: gives the bounds; may be replaced.

    Attributes:
        solver: as given.
        unknown: in how many steps the last acceleration was not known.
    """

    def __init__(self, solver: JerkBoundsSolver) -> None:
        self.solver = solver
        self.unknown = 0
        self.reset()

    def reset(self) -> None:
        """Start with an arm that is not accelerated."""
        self._lowest = self._highest = np.zeros(len(self.solver.limits))

    def bounds(self, q: Array, v: Array) -> AccelerationBounds:
        """Return the bounds of the next step at a state, arrays of shape (n,), rad and rad/s."""
        self.unknown += self._lowest is not self._highest
        bounds = self.solver.bounds(q, v, self._lowest, self._highest)
        self._lowest, self._highest = bounds.lower, bounds.upper
        return bounds

    def commanded(self, a: Array) -> None:
        """Tell the acceleration of the step of the last bounds, shape (n,), rad/s^2."""
        self._lowest = self._highest = a
