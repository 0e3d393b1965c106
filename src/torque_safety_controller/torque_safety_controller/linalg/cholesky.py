# SPDX-License-Identifier: Apache-2.0
"""Cholesky's factorisation of small matrices, compiled.

For 6 to 9 rows NumPy's and LAPACK's take several times as long, and report a matrix that is not
positive definite by an exception, with which compiled code leaks memory.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from viability_bounds_pkg.compiled import compiled

Array = NDArray[np.float64]


@compiled
def factorise(A: Array) -> bool:
    """Replace the lower triangle of A, shape (m, m), by L with A = L L'.

    Returns whether A is positive definite, of finite numbers; if not, it is left half done.
    """
    for j in range(len(A)):
        pivot = A[j, j]
        for k in range(j):
            pivot -= A[j, k] * A[j, k]
        if not 0.0 < pivot < math.inf:
            return False
        A[j, j] = math.sqrt(pivot)
        for i in range(j + 1, len(A)):
            for k in range(j):
                A[i, j] -= A[i, k] * A[j, k]
            A[i, j] /= A[j, j]
    return True


@compiled
def solve(L: Array, B: Array) -> None:
    """Replace B, shape (m, k), by (L L')^-1 B, L as `factorise` leaves it."""
    m, k = B.shape
    for i in range(m):
        for j in range(i):
            for c in range(k):
                B[i, c] -= L[i, j] * B[j, c]
        for c in range(k):
            B[i, c] /= L[i, i]
    for i in range(m - 1, -1, -1):
        for j in range(i + 1, m):
            for c in range(k):
                B[i, c] -= L[j, i] * B[j, c]
        for c in range(k):
            B[i, c] /= L[i, i]
