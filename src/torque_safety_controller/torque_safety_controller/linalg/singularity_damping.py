"""Damping of the directions in which a Jacobian is nearly singular, and of those only.

With G = J J^T = sum g_i u_i u_i^T, where g_i is the square of a singular value of J, and the
threshold e,

    D = h(G) = sum h(g_i) u_i u_i^T,    h(g) = (e^2 - g)^2 / e^2 below e^2, 0 above.

h is C1, so that D has a continuous derivative also where eigenvalues meet (Daleckii and Krein),

    D' = U (F o (U^T G' U)) U^T,   F_ij = (h(g_i) - h(g_j)) / (g_i - g_j),   F_ii = h'(g_i),

with o the product entry by entry. For this h the quotients have closed forms without
cancellation.
"""

from __future__ import annotations

import math

import numpy as np

from torque_safety_controller.linalg.cholesky import factorise
from viability_bounds_pkg.compiled import compiled

_SWEEPS = 12  # Jacobi's method converges quadratically: 5 suffice for 6 rows, 7 for 12


@compiled
def is_clear_of_singularities(G: np.ndarray, threshold: float) -> bool:
    """Return whether every eigenvalue of `G`, shape (m, m), is above ``threshold^2``."""
    S = G.copy()
    for i in range(len(S)):
        S[i, i] -= threshold * threshold
    return factorise(S)


@compiled
def symmetric_eigen(G: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return eigenvalues, shape (m,), and eigenvectors, columns of shape (m, m): Jacobi's method.

    Args:
        G: symmetric, shape (m, m).
    """
    m = len(G)
    A = G.copy()
    U = np.eye(m)
    for _ in range(_SWEEPS):
        largest = 0.0
        scale = 0.0
        for i in range(m):
            scale = max(scale, abs(A[i, i]))
            for j in range(i):
                largest = max(largest, abs(A[i, j]))
        if largest <= 1e-17 * scale:
            break
        for p in range(m - 1):
            for q in range(p + 1, m):
                if A[p, q] == 0.0:
                    continue
                slope = (A[q, q] - A[p, p]) / (2.0 * A[p, q])
                t = math.copysign(1.0, slope) / (abs(slope) + math.hypot(slope, 1.0))
                c = 1.0 / math.sqrt(t * t + 1.0)
                s = t * c
                for k in range(m):
                    x, y = A[k, p], A[k, q]
                    A[k, p] = c * x - s * y
                    A[k, q] = s * x + c * y
                for k in range(m):
                    x, y = A[p, k], A[q, k]
                    A[p, k] = c * x - s * y
                    A[q, k] = s * x + c * y
                A[p, q] = 0.0
                A[q, p] = 0.0
                for k in range(m):
                    x, y = U[k, p], U[k, q]
                    U[k, p] = c * x - s * y
                    U[k, q] = s * x + c * y
    return np.diag(A).copy(), U


@compiled
def damping(G: np.ndarray, G_dot: np.ndarray, threshold: float) -> tuple[np.ndarray, np.ndarray]:
    """Return D = h(G) and D', shape (m, m) each.

    Args:
        G: J J^T, shape (m, m).
        G_dot: its time derivative, shape (m, m).
        threshold: singular value of J below which a direction is damped.
    """
    m = len(G)
    e2 = threshold * threshold
    g, U = symmetric_eigen(G)
    D, D_dot = np.zeros((m, m)), np.zeros((m, m))
    for i in range(m):
        for j in range(i + 1):
            below_i, below_j = max(e2 - g[i], 0.0), max(e2 - g[j], 0.0)
            if below_i == 0.0 and below_j == 0.0:
                continue
            if below_i > 0.0 and below_j > 0.0:
                quotient = -(below_i + below_j) / e2
            else:
                # One below and one above: |g_i - g_j| is at least the part below.
                below = below_i + below_j
                quotient = -below / e2 * (below / abs(g[i] - g[j]))
            rate = 0.0
            for k in range(m):
                for r in range(m):
                    rate += U[k, i] * G_dot[k, r] * U[r, j]
            rate *= quotient
            for k in range(m):
                for r in range(m):
                    if i == j:
                        D[k, r] += below_i * below_i / e2 * U[k, i] * U[r, i]
                        D_dot[k, r] += rate * U[k, i] * U[r, i]
                    else:
                        D_dot[k, r] += rate * (U[k, i] * U[r, j] + U[k, j] * U[r, i])
    return D, D_dot
