"""Small dense linear algebra, compiled: for matrices of 7 columns NumPy is mostly overhead.

A step of the controller calls these a few times; each saves ten or so array operations, of
which every one costs more than the arithmetic in it. The compiled code is cached beside this
file, so that only the first start on a machine pays for compiling.
"""

from __future__ import annotations

import numpy as np

from torque_safety_controller.linalg.cholesky import factorise, solve_vector
from viability_bounds_pkg.compiled import compiled


@compiled
def clear_cost(H: np.ndarray, g: np.ndarray, gamma: float) -> None:
    """Make the cost ``x' H x / 2 + g' x`` into ``gamma |x|^2 / 2``, in place."""
    n = len(g)
    for i in range(n):
        for j in range(n):
            H[i, j] = 0.0
        H[i, i] = gamma
        g[i] = 0.0


@compiled
def add_rows(
    H: np.ndarray, g: np.ndarray, A: np.ndarray, b: np.ndarray, weight: float, first: int
) -> None:
    """Add ``weight * |A z - b|^2 / 2`` to the cost ``x' H x / 2 + g' x``, in place.

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
def add_identity(H: np.ndarray, g: np.ndarray, b: np.ndarray, weight: float) -> None:
    """Add ``weight * |z - b|^2 / 2`` to the cost ``x' H x / 2 + g' x``, z the first of x."""
    for i in range(len(b)):
        H[i, i] += weight
        g[i] -= weight * b[i]


@compiled
def middle_of_step(
    q: np.ndarray, v: np.ndarray, a: np.ndarray, dt: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return position and velocity after dt / 2 at acceleration `a`, shape (n,) each."""
    half = 0.5 * dt
    return q + half * (v + 0.5 * half * a), v + half * a


@compiled
def spring_damper_rows(
    J: np.ndarray, v: np.ndarray, error: np.ndarray, drift: np.ndarray, kp: float, kd: float
) -> np.ndarray:
    """Return ``kp error - kd J v - drift``, shape (m,), J of shape (m, n)."""
    m, n = J.shape
    b = np.empty(m)
    for i in range(m):
        s = 0.0
        for k in range(n):
            s += J[i, k] * v[k]
        b[i] = kp * error[i] - kd * s - drift[i]
    return b


@compiled
def spring_damper(error: np.ndarray, v: np.ndarray, kp: float, kd: float) -> np.ndarray:
    """Return ``kp error - kd v``, shape (n,)."""
    return kp * error - kd * v


@compiled
def null_space_part(J: np.ndarray, x: np.ndarray, regularisation: float) -> np.ndarray:
    """Return ``x - J^T (J J^T + regularisation I)^-1 J x``, shape (n,), J of shape (m, n)."""
    m, n = J.shape
    G = np.empty((m, m))
    y = np.empty(m)
    for i in range(m):
        s = 0.0
        for k in range(n):
            s += J[i, k] * x[k]
        y[i] = s
        for j in range(i + 1):
            s = 0.0
            for k in range(n):
                s += J[i, k] * J[j, k]
            G[i, j] = s
        G[i, i] += regularisation
    result = x.copy()
    if factorise(G):
        solve_vector(G, y)
        for k in range(n):
            s = 0.0
            for i in range(m):
                s += J[i, k] * y[i]
            result[k] -= s
    return result
