# SPDX-License-Identifier: Apache-2.0
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
def write_plain(
    H: Array,
    g: Array,
    C: Array,
    lower: Array,
    upper: Array,
    gamma: float,
    a_lower: Array,
    a_upper: Array,
    M: Array,
    tau_lower: Array,
    tau_upper: Array,
) -> None:
    """Write a program in x = (a, rho) with C = (M, 0; 0, 0) and the cost gamma |x|^2 / 2.

    Args:
        H: shape (n + r, n + r), written, like the next four.
        g: shape (n + r,).
        C: shape (n + k, n + r).
        lower: of a, rho, M a and k more, shape (n + r + n + k,); zero but for a and M a.
        upper: same shape.
        gamma: weight of |x|^2.
        a_lower: limits of a, shape (n,).
        a_upper: shape (n,).
        M: shape (n, n).
        tau_lower: limits of M a, shape (n,).
        tau_upper: shape (n,).
    """
    n, size = len(a_lower), len(g)
    for i in range(size):
        for j in range(size):
            H[i, j] = 0.0
        H[i, i] = gamma
        g[i] = lower[i] = upper[i] = 0.0
    for i in range(len(C)):
        for j in range(size):
            C[i, j] = 0.0
        lower[size + i] = upper[size + i] = 0.0
    for i in range(n):
        for j in range(n):
            C[i, j] = M[i, j]
        lower[i], upper[i] = a_lower[i], a_upper[i]
        lower[size + i], upper[size + i] = tau_lower[i], tau_upper[i]


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
