# SPDX-License-Identifier: Apache-2.0
"""Compiled parts of null-space compliance: a task's inverse with its rate, and a step.

The dynamically consistent inverse of a task Jacobian is

    J^+ = M^-1 J^T (J M^-1 J^T + c D)^-1,   c = n / tr M                            [Khatib1995]

Torques in the null space of its transpose do not accelerate the task. D damps the directions in
which J is nearly singular; it is exactly zero while all singular values of J are above a
threshold, and its derivative is continuous there. With X = M^-1 J^T and Y = J X + c D,

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

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]

THRESHOLD = 0.03
"""Singular value of J below which its direction is damped."""


@njit(cache=True)
def dynamically_consistent_inverse(
    J: Array, J_dot: Array, M: Array, M_dot: Array, threshold: float
) -> tuple[Array, Array]:
    """Return J^+ and its time derivative, shape (n, m) each.

    Args:
        J: Jacobian of the task, shape (m, n) with m < n; this and the others contiguous.
        J_dot: its time derivative, shape (m, n).
        M: mass matrix, shape (n, n), kg m^2.
        M_dot: its time derivative, shape (n, n); C + C^T with Pinocchio's Coriolis matrix.
        threshold: singular value of J below which its direction is damped, in units of J. Rows
            of different units can be scaled to like size before; that changes the damping only.

    Raises:
        LinAlgError: M is singular, or there are numbers that are not finite.
    """
    M_inv = np.linalg.inv(M)
    X = M_inv @ J.T
    M_dot_X, J_dot_X = M_dot @ X, J_dot @ X
    Y, Y_dot = J @ X, J_dot_X + J_dot_X.T - X.T @ M_dot_X
    half = J_dot @ J.T
    D, D_dot = damping(J @ J.T, half + half.T, threshold)
    if D.any():
        trace = np.trace(M)
        scale = len(M) / trace
        Y += scale * D
        Y_dot += scale * (D_dot - np.trace(M_dot) / trace * D)
    Y_inv = np.linalg.inv(Y)
    J_plus = X @ Y_inv
    X_dot = M_inv @ (J_dot.T - M_dot_X)
    return J_plus, (X_dot - J_plus @ Y_dot) @ Y_inv


@njit(cache=True)
def damping(G: Array, G_dot: Array, threshold: float) -> tuple[Array, Array]:
    """Return D = h(G) and D', shape (m, m) each.

    Args:
        G: J J^T, shape (m, m).
        G_dot: its time derivative, shape (m, m).
        threshold: singular value of J below which a direction is damped.
    """
    e2 = threshold * threshold
    g, U = np.linalg.eigh(G)
    below = np.maximum(e2 - g, 0.0)
    F = np.zeros_like(G)
    if not below.any():
        return F, F
    for i in range(len(g)):
        for j in range(len(g)):
            sum_below = below[i] + below[j]
            if below[i] > 0.0 and below[j] > 0.0:
                F[i, j] = -sum_below / e2
            elif sum_below > 0.0:
                # One below and one above: |g_i - g_j| is at least the part below.
                F[i, j] = -sum_below / e2 * (sum_below / abs(g[i] - g[j]))
    D = (U * (below * below / e2)) @ U.T
    return D, U @ (F * (U.T @ G_dot @ U)) @ U.T


@njit(cache=True)
def torque_matrix(
    J: Array,
    J_dot: Array,
    M: Array,
    C: Array,
    gain: float,
    mu: float,
    J_plus: Array,
    J_plus_dot: Array,
) -> Array:
    """Return H of the torque H a - mu K x of eq. (21) with (26), shape (n, n)."""
    K = gain * np.diag(M)
    P = J_plus @ J
    # J^+ J' s + (J^+)' integral, where s = (1 - P) a and integral = - J a.
    H = C - M @ (J_plus @ (J_dot - J_dot @ P) - J_plus_dot @ J)
    H += (1.0 - mu) * ((P.T * K) @ P) + mu * np.diag(K)
    return H


@njit(cache=True)
def advance(
    a_old: Array,
    s_old: Array,
    integral_old: Array,
    root: Array,
    J_old: Array,
    J: Array,
    J_dot: Array,
    M: Array,
    C: Array,
    increment: Array,
    gain: float,
    mu: float,
    slow: float,
    slow_gain: float,
    fast: float,
    fast_gain: float,
    null: float,
) -> tuple[Array, Array, Array, Array, Array]:
    """Return a, x and the torque after a step, shape (n,) each, J^+ and `torque_matrix`.

    Args:
        a_old: memory of the last step, as the next four; see `NullspaceCompliance`.
        s_old: shape (n,), rad/s.
        integral_old: shape (m,).
        root: shape (n,).
        J_old: shape (m, n).
        J: Jacobian of the task, shape (m, n).
        J_dot: its time derivative.
        M: mass matrix, shape (n, n).
        C: Coriolis matrix, shape (n, n).
        increment: of s, shape (n,), rad/s.
        gain: lambda, 1/s.
        mu: weight of the fast memory.
        slow: what a step leaves of the slow memory.
        slow_gain: what it takes of the increment.
        fast: the same of the fast memory.
        fast_gain: likewise.
        null: what is left in the null space of what the slow memory keeps.
    """
    J_plus, J_plus_dot = dynamically_consistent_inverse(J, J_dot, M, C + C.T, THRESHOLD)
    ratio = fast_gain / slow_gain
    left = slow * s_old
    s = left + slow_gain * increment
    # With the middle of s the product rule is exact: J a grows by the middle of J times the
    # increment of s.
    integral = slow * integral_old + (J - J_old) @ (0.5 * (left + s))
    a = s - J_plus @ integral
    # The fast memory takes fast_gain of what a gained, of which slow_gain is seen.
    x = (1.0 - ratio) * a + (ratio * slow - fast) * a_old + fast * root / np.sqrt(np.diag(M))
    a = a - (1.0 - null) * (a - J_plus @ (J @ a))
    H = torque_matrix(J, J_dot, M, C, gain, mu, J_plus, J_plus_dot)
    return a, x, H @ a - mu * gain * np.diag(M) * x, J_plus, H
