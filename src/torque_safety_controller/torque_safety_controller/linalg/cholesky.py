"""Cholesky's factorisation of small matrices, compiled, kept apart from its solves."""

from __future__ import annotations

import math

import numpy as np

from viability_bounds_pkg.compiled import compiled


@compiled
def factorise(A: np.ndarray) -> bool:
    """Replace the lower triangle of `A`, shape (n, n), by L with ``A = L L^T``.

    Returns:
        False, with `A` undefined, when A is not numerically positive definite.
    """
    n = A.shape[0]
    for j in range(n):
        d = A[j, j]
        for k in range(j):
            d -= A[j, k] * A[j, k]
        if not (d > 0.0 and d < math.inf):
            return False
        d = math.sqrt(d)
        A[j, j] = d
        for i in range(j + 1, n):
            s = A[i, j]
            for k in range(j):
                s -= A[i, k] * A[j, k]
            A[i, j] = s / d
    return True


@compiled
def solve_vector(L: np.ndarray, x: np.ndarray) -> None:
    """Replace `x`, shape (n,), by ``(L L^T)^-1 x``; L as `factorise` leaves it."""
    n = len(x)
    for i in range(n):
        s = x[i]
        for k in range(i):
            s -= L[i, k] * x[k]
        x[i] = s / L[i, i]
    for i in range(n - 1, -1, -1):
        s = x[i]
        for k in range(i + 1, n):
            s -= L[k, i] * x[k]
        x[i] = s / L[i, i]
