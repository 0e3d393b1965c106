# SPDX-License-Identifier: Apache-2.0
"""The dynamically consistent inverse of a task Jacobian, damped near singularities, and its rate.

The inverse is

    J^+ = X Y^-1,   X = M^-1 J^T,   Y = J X + c D,   c = n / tr M                   [Khatib1995]

Torques in the null space of its transpose do not accelerate the task. D damps the directions in
which J is nearly singular; it is exactly zero while all singular values of J are above a
threshold, and its derivative is continuous there. With ' for the rate,

    X' = M^-1 (J'^T - M' X),   Y' = J' X + J X' + c D' + c' D,   (J^+)' = (X' - J^+ Y') Y^-1,

where J X' = (J' X)^T - X^T M' X. The damping leaves ``J J^+ = 1 - c D Y^-1``: identity in all
directions that are not damped.

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
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

Array = NDArray[np.float64]

THRESHOLD = 0.03
"""Singular value of J below which its direction is damped."""

_TINY = 1e-300  # for 0, so that it can be divided by


class TaskInverse(NamedTuple):
    """J^+ in factors.

    Attributes:
        X: M^-1 J^T, shape (n, m).
        Y_inv: Y^-1, which is symmetric, shape (m, m).
        damping_rate: the rate of c D, shape (m, m).
    """

    X: Array
    Y_inv: Array
    damping_rate: Array


def task_inverse(
    J: Array, J_dot: Array, M: Array, M_dot: Array, threshold: float = THRESHOLD
) -> TaskInverse:
    """Return J^+ in factors.

    Args:
        J: Jacobian of the task, shape (m, n) with m < n.
        J_dot: its time derivative, shape (m, n).
        M: mass matrix, shape (n, n), kg m^2.
        M_dot: its time derivative, shape (n, n); C + C^T with Pinocchio's Coriolis matrix.
        threshold: singular value of J below which its direction is damped, in units of J. Rows
            of different units can be scaled to like size before; that changes the damping only.

    Raises:
        ValueError: M is not positive definite, or there are numbers that are not finite.
    """
    X, G = _solved(M, J.T), J.dot(J.T)
    Y, e2 = J.dot(X), threshold * threshold
    if not math.isfinite(sum(G.diagonal().tolist())):
        raise ValueError("the Jacobian must be finite")
    g, U, _ = lapack.dsyev(G)
    if g[0] >= e2:
        return TaskInverse(X, _solved(Y, np.eye(len(Y))), np.zeros(Y.shape))
    below, half, trace = np.maximum(e2 - g, 0.0), J_dot @ J.T, M.trace()
    D = (U * (below * below / e2)) @ U.T
    # F_ij is - sum / e^2 for two eigenvalues below e^2; for one above, sum / |g_i - g_j| of it.
    total, apart = np.add.outer(below, below), np.abs(np.subtract.outer(g, g))
    F = -total / e2 * (total / (np.maximum(apart, total) + _TINY))
    D_dot = U @ (F * (U.T @ (half + half.T) @ U)) @ U.T
    c = len(M) / trace
    Y_inv = _solved(Y + c * D, np.eye(len(Y)))
    return TaskInverse(X, Y_inv, c * (D_dot - M_dot.trace() / trace * D))


def dynamically_consistent_inverse(
    J: Array, J_dot: Array, M: Array, M_dot: Array, threshold: float = THRESHOLD
) -> tuple[Array, Array]:
    """Return J^+ and its time derivative, shape (n, m) each; see `task_inverse`."""
    X, Y_inv, damping_rate = task_inverse(J, J_dot, M, M_dot, threshold)
    M_dot_X, J_dot_X, J_plus = M_dot @ X, J_dot @ X, X @ Y_inv
    Y_dot = J_dot_X + J_dot_X.T - X.T @ M_dot_X + damping_rate
    X_dot = _solved(M, J_dot.T - M_dot_X)
    return J_plus, (X_dot - J_plus @ Y_dot) @ Y_inv


def _solved(A: Array, B: Array) -> Array:
    """Return A^-1 B for a positive definite A; else raise `ValueError`."""
    # LAPACK itself: SciPy's and NumPy's functions take several times as long for small matrices.
    _, X, failed = lapack.dposv(A, B)
    if failed:
        raise ValueError("M must be positive definite, and all numbers finite")
    return X
