"""Vectors of three numbers as tuples, compiled: they stay in registers, and allocate nothing."""

from __future__ import annotations

import numpy as np

from viability_bounds_pkg.compiled import compiled

compiled = compiled(error_model="numpy", _nrt=False)
"""Compiles what allocates no arrays. To count references to those it is given, as numba does for
each one taken out of a tuple, takes several times longer than the arithmetic here."""


@compiled
def at(A: np.ndarray, i: int):
    """Return row `i` of an array of shape (m, 3)."""
    return A[i, 0], A[i, 1], A[i, 2]


@compiled
def dot(a, b):
    """Return a . b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@compiled
def cross(a, b):
    """Return a x b."""
    return (
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    )


@compiled
def sub(a, b):
    """Return a - b."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@compiled
def along(a, s, u):
    """Return a + s u."""
    return a[0] + s * u[0], a[1] + s * u[1], a[2] + s * u[2]


@compiled
def column(R: np.ndarray, k: int):
    """Return column `k` of an array of shape (3, 3)."""
    return R[0, k], R[1, k], R[2, k]


@compiled
def turned(R: np.ndarray, a):
    """Return R a."""
    return (
        R[0, 0] * a[0] + R[0, 1] * a[1] + R[0, 2] * a[2],
        R[1, 0] * a[0] + R[1, 1] * a[1] + R[1, 2] * a[2],
        R[2, 0] * a[0] + R[2, 1] * a[1] + R[2, 2] * a[2],
    )
