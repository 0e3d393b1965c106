"""The torque of null-space compliance and the energy it stores, compiled.

`docs/nullspace_compliance.md` derives both. The torque is linear in the memory (s, integral, a,
x), the energy quadratic; x is what the fast memory has forgotten, a_fast = a - x.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from viability_bounds_pkg.compiled import compiled


class Law(NamedTuple):
    """Numbers of `NullspaceSettings`."""

    lambda_: float
    mu: float
    theta_slow: float
    theta_fast: float
    theta_null: float
    threshold: float
    blend_time: float
    widening_time: float
    free_null_space: bool
    dynamically_consistent: bool
    keep_integral: bool


class Terms(NamedTuple):
    """What a step needs of the robot: shapes (n, n), (m, n), (n, m); K is a diagonal, (n,)."""

    M: np.ndarray
    C: np.ndarray
    J: np.ndarray
    J_dot: np.ndarray
    J_plus: np.ndarray
    J_plus_dot: np.ndarray
    J_bar: np.ndarray
    """The dynamically consistent inverse, whichever J_plus is."""
    K: np.ndarray


@compiled
def times(A: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return ``A x``."""
    rows, columns = A.shape
    y = np.zeros(rows)
    for i in range(rows):
        for j in range(columns):
            y[i] += A[i, j] * x[j]
    return y


@compiled
def transpose_times(A: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return ``A^T x``."""
    rows, columns = A.shape
    y = np.zeros(columns)
    for i in range(rows):
        for j in range(columns):
            y[j] += A[i, j] * x[i]
    return y


@compiled
def split(law: Law, terms: Terms, a: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return s and integral that make up `a`: of all those, what it takes the form to be."""
    if law.keep_integral:
        return a.copy(), np.zeros(len(terms.J))
    integral = -times(terms.J, a)
    return a + times(terms.J_plus, integral), integral


@compiled
def law_torque(
    law: Law, terms: Terms, s: np.ndarray, integral: np.ndarray, a: np.ndarray, x: np.ndarray
) -> np.ndarray:
    """Return the additional torque of eq. (21), with (26) or K a, shape (n,)."""
    n = len(a)
    inner = times(terms.J_plus, times(terms.J_dot, s)) + times(terms.J_plus_dot, integral)
    if law.free_null_space:
        stiff = terms.K * times(terms.J_plus, times(terms.J, a))
        stiff = transpose_times(terms.J, transpose_times(terms.J_plus, stiff))
    else:
        stiff = terms.K * a
    tau = np.empty(n)
    for i in range(n):
        t = (1.0 - law.mu) * stiff[i] + law.mu * terms.K[i] * (a[i] - x[i])
        for j in range(n):
            t += terms.C[i, j] * a[j] - terms.M[i, j] * inner[j]
        tau[i] = t
    return tau


@compiled
def energy_product(
    law: Law, M: np.ndarray, a: np.ndarray, x: np.ndarray, b: np.ndarray, y: np.ndarray
) -> float:
    """Return the inner product of (a, x) and (b, y) whose square is twice the energy, J."""
    n = len(a)
    weight = 0.0
    if law.theta_fast > law.theta_slow:
        weight = law.mu * law.lambda_ / (law.theta_fast - law.theta_slow)
    total = 0.0
    for i in range(n):
        t = weight * M[i, i] * x[i] * y[i]
        for j in range(n):
            t += a[i] * M[i, j] * b[j]
        total += t
    return total
