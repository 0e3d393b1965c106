# SPDX-License-Identifier: Apache-2.0
"""The largest gain with which an integral action is stable where the arm is."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from torque_safety_controller.linalg import cholesky
from viability_bounds_pkg.compiled import compiled

Array = NDArray[np.float64]

_FIRST = 50
"""Iterations from a vector of which nothing is known; from the last state's two are enough."""

_BACK = 0.5
"""Steps by which the gain could be higher before it is raised."""


class StableGain:
    """Lowers the gain of an integral action in postures in which it would be unstable.

    With K = lambda D, D = diag(M), the errors s of the speeds of an ideal arm become

        s_next = (I - lambda h M^-1 D) s

    in a period h: they grow where lambda h f > 2, f the largest eigenvalue of M^-1 D, and change
    sign where it is above 1. A joint alone has f = 1; coupled ones have more, those of Panda in
    its worst posture 77. The gain is lowered by powers of sqrt(2), so that it changes seldom.

    Args:
        n: number of joints.
    """

    def __init__(self, n: int) -> None:
        self._vector = np.zeros(n)
        self._steps = 0
        _coupling(np.eye(n), self._vector, 1)  # compiled now, not in a control loop
        self.reset()

    def reset(self) -> None:
        """Forget the posture."""
        self._vector.fill(0.0)

    def of(self, wanted: float, M: Array, period: float, most: float) -> float:
        """Return the gain to be used, 1/s: `wanted`, or less.

        Args:
            wanted: lambda, 1/s.
            M: mass matrix, shape (n, n), kg m^2; if it is none the gain stays lowered as it was.
            period: h, s.
            most: lambda h f that is allowed.
        """
        share = wanted * period * _coupling(M, self._vector, _FIRST) / most
        if 0.0 < share < math.inf:
            steps = 2.0 * math.log2(share)
            if not steps <= self._steps <= steps + 1.0 + _BACK:
                self._steps = max(0, math.ceil(steps))
        return wanted * 2.0 ** (-0.5 * self._steps)


@compiled
def _coupling(M: Array, vector: Array, first: int) -> float:
    """Return the largest eigenvalue of M^-1 D by power iteration; NaN where M is no mass matrix.

    `vector`, shape (n,), goes on from one call to the next; zeros begin anew.
    """
    n, L = len(M), M.copy()
    if not cholesky.factorise(L):
        return np.nan
    iterations = 2
    if not vector.any():
        # Not symmetric, so that it is at right angles to no eigenvector that matters.
        for i in range(n):
            vector[i] = 1.0 + 0.1 * i
        iterations = first
    found, y = 0.0, np.empty((n, 1))
    for _ in range(iterations):
        size = math.sqrt((vector * vector).sum())
        for i in range(n):
            y[i, 0] = math.sqrt(M[i, i]) * vector[i] / size
        cholesky.solve(L, y)
        for i in range(n):
            vector[i] = math.sqrt(M[i, i]) * y[i, 0]
        found = math.sqrt((vector * vector).sum())
    return found
