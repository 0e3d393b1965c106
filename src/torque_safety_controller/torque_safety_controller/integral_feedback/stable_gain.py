# SPDX-License-Identifier: Apache-2.0
"""Gains of the integral action that are stable in the posture of the arm.

With K = lambda D, D = diag(M), the errors s of the speeds of an ideal arm become

    s_next = (I - lambda h M^-1 D) s

in a period h. With f the largest eigenvalue of M^-1 D they grow where lambda h f > 2, and change
sign where it is above 1. A joint alone has f = 1; coupled ones have more, those of Panda in its
worst posture 77.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_CHECK_EVERY = 5
"""Control steps after which the gain is checked: in between the posture is nearly the same."""

_ROOM_TO_RAISE = 0.5
"""Steps by which the gain could be higher before it is raised."""


class StableGain:
    """Lowers a gain by powers of sqrt(2), so that it changes seldom.

    Args:
        most: largest product lambda h f.
    """

    def __init__(self, most: float) -> None:
        self._most = most
        self._asked = math.nan
        self._lowered = 0
        self._steps_left = 0

    def check_next(self) -> None:
        """Check the gain in the next step: the posture may be any."""
        self._steps_left = 0

    def gain(self, asked: float, M: Array, period: float) -> float:
        """Return the gain to use in this control step, 1/s, at most `asked`.

        Args:
            asked: lambda, 1/s.
            M: mass matrix, shape (n, n), kg m^2.
            period: h, s.
        """
        self._steps_left -= 1
        if self._steps_left < 0 or asked != self._asked:
            self._steps_left, self._asked = _CHECK_EVERY - 1, asked
            share = asked * period * coupling(M) / self._most
            if 0.0 < share < math.inf:
                steps = 2.0 * math.log2(share)
                if not steps <= self._lowered <= steps + 1.0 + _ROOM_TO_RAISE:
                    self._lowered = max(0, math.ceil(steps))
        return asked * 2.0 ** (-0.5 * self._lowered)


def coupling(M: Array) -> float:
    """Return f, the largest eigenvalue of M^-1 D; NaN where M is no mass matrix."""
    inertia = np.diagonal(M)
    if not (math.isfinite(M.sum()) and inertia.min() > 0.0):
        return math.nan
    root = np.sqrt(inertia)
    least = float(np.linalg.eigvalsh(M / np.outer(root, root))[0])
    return 1.0 / least if least > 0.0 else math.nan
