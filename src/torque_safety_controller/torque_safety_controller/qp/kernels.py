"""Compiled inner loops of building a program and checking its solution.

Written with NumPy each costs 5 to 20 % more of a control step (`scripts/bench.sh step`).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from viability_bounds_pkg.compiled import compiled

Array = NDArray[np.float64]


@compiled
def add_least_squares(H: Array, g: Array, A: Array, b: Array, weight: float, first: int) -> None:
    """Add ``weight * |A z - b|^2 / 2`` to the cost ``x'Hx / 2 + g'x``, in place.

    z are as many of x as A has columns, from index `first` on.
    """
    m, n = A.shape
    for i in range(n):
        for j in range(i + 1):
            s = 0.0
            for k in range(m):
                s += A[k, i] * A[k, j]
            s *= weight
            H[first + i, first + j] += s
            if i != j:
                H[first + j, first + i] += s
        s = 0.0
        for k in range(m):
            s += A[k, i] * b[k]
        g[first + i] -= weight * s


@compiled
def add_identity(H: Array, g: Array, b: Array, weight: float) -> None:
    """Add ``weight * |z - b|^2 / 2`` to the cost ``x'Hx / 2 + g'x``, z the first of x."""
    for i in range(len(b)):
        H[i, i] += weight
        g[i] -= weight * b[i]


@compiled
def clip_and_check(
    x: Array,
    C: Array,
    lower: Array,
    upper: Array,
    violation: float,
    multipliers: Array,
    sense: NDArray[np.int32],
) -> bool:
    """Clip x to its own limits, in place; return whether it and C x are finite and in limits.

    Args:
        x: shape (p,).
        C: shape (m, p).
        lower: of x, then of C x, shape (p + m,).
        upper: same shape.
        violation: that is allowed of the limits of C x.
        multipliers: shape (p + m,), > 0 where the upper limit is active, < 0 for the lower.
        sense: shape (p + m,), written: what is active, as DAQP takes it.
    """
    m, p = C.shape
    for i in range(p):
        if not (math.isfinite(x[i]) and lower[i] <= upper[i]):
            return False
        x[i] = min(max(x[i], lower[i]), upper[i])
    for i in range(m):
        value = 0.0
        for j in range(p):
            value += C[i, j] * x[j]
        low, high = lower[p + i] - violation, upper[p + i] + violation
        # So put that it is false where something is NaN.
        if not (math.isfinite(value) and low <= value <= high):
            return False
    for i in range(m + p):
        sense[i] = 1 if multipliers[i] > 0.0 else 3 if multipliers[i] < 0.0 else 0
    return True
