# SPDX-License-Identifier: Apache-2.0
"""Compiled step of null-space compliance: a task's inverse with its rate, the law, and limits.

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

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]

THRESHOLD = 0.03
"""Singular value of J below which its direction is damped."""

_SINGULAR = 1e-12  # relative size of pivots that are rounding


@njit(cache=True)
def advance(
    memory: tuple[Array, ...],
    arm: tuple[Array, ...],
    reference: Array,
    dt: float,
    budget: Array,
    numbers: tuple[float, float, float],
    factors: tuple[float, float, float, float],
) -> tuple[Array, Array, Array, Array, Array, bool, bool]:
    """Return the memory after a step, and its torque.

    Args:
        memory: of the last step, see `nullspace.Memory`.
        arm: its terms, see `ArmTerms`.
        reference: acceleration commanded in the last step, shape (n,), rad/s^2.
        dt: time since, s.
        budget: shape (n,), N m.
        numbers: gain lambda, 1/s; weight mu of the fast memory, and that of its energy.
        factors: what a step leaves of the slow memory, and what it takes of the increment of s;
            the same of the fast memory, whose rate the slow one has in the null space.

    Returns:
        The first four of the memory; the torque, shape (n,), N m; whether it is limited; whether
        all is finite, and M can be a mass matrix.
    """
    a_last, s_last, integral, root, v_last, J_last = memory
    M, C, J, J_dot, v = arm
    gain, mu, weight = numbers
    slow, slow_gain, fast, fast_gain = factors
    total = M.sum() + C.sum() + J.sum() + J_dot.sum() + v.sum() + reference.sum()
    if not (math.isfinite(total) and (np.diag(M) > 0.0).all()):
        return a_last, s_last, integral, root, v, False, False
    J_plus, J_plus_dot = dynamically_consistent_inverse(J, J_dot, M, C + C.T, THRESHOLD)
    ratio = fast_gain / slow_gain
    left = slow * s_last
    s = left + slow_gain * (reference * dt - (v - v_last))
    # With the middle of s the product rule is exact: J a grows by the middle of J times the
    # increment of s.
    a = s - J_plus @ (slow * integral + (J - J_last) @ (0.5 * (left + s)))
    # The fast memory takes fast_gain of what a gained, of which slow_gain is seen.
    x = (1.0 - ratio) * a + (ratio * slow - fast) * a_last + fast * root / np.sqrt(np.diag(M))
    a = a - (1.0 - fast / slow) * (a - J_plus @ (J @ a)) if slow > 0.0 else a
    H = torque_matrix(J, J_dot, M, C, gain, mu, J_plus, J_plus_dot)
    torque = H @ a - mu * gain * np.diag(M) * x
    a, x, torque, cut = limited(M, H, budget, a, x, torque, weight)
    integral = -(J @ a)
    finite = math.isfinite(torque.sum() + a.sum() + x.sum() + integral.sum())
    return a, a + J_plus @ integral, integral, np.sqrt(np.diag(M)) * x, torque, cut, finite


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
def limited(
    M: Array, H: Array, limit: Array, a: Array, x: Array, torque: Array, weight: float
) -> tuple[Array, Array, Array, bool]:
    """Return a memory and its torque with |torque| <= limit that stores no more energy.

    Scaling all of the memory by (10) does both, but weakens every joint for the sake of one.
    So a is changed such that only the torques beyond their limits change, to the limits. If
    that stores more energy than before, it is done in part: the memory is the furthest point
    on the way from the scaled one that does not. Both ends are within the limits, and with
    them the way.

    Args:
        M: mass matrix, shape (n, n).
        H: of `torque_matrix`.
        limit: shape (n,), >= 0, may be infinite.
        a: shape (n,).
        x: shape (n,).
        torque: that they give, shape (n,).
        weight: of the fast memory in the energy, see `fast_weight`.

    Returns:
        a, x and their torque, shape (n,) each, and whether they had to be changed.
    """
    scale = 1.0
    for i in range(len(limit)):
        if abs(torque[i]) > limit[i]:
            scale = min(scale, limit[i] / abs(torque[i]))
    if not scale < 1.0:
        return a, x, torque, False
    cut = np.minimum(np.maximum(torque, -limit), limit) - torque
    regular = H + _SINGULAR * (np.abs(H).max() + 1e-300) * np.eye(len(H))
    shift, way = np.linalg.solve(regular, cut), 0.0
    if np.abs(H @ shift - cut).max() <= 1e-6 * np.abs(cut).max():
        # How far from (scale a, scale x) to (a + shift, x) the energy is that of (a, x).
        da, dx = (1.0 - scale) * a + shift, (1.0 - scale) * x
        weights = weight * np.diag(M)
        energy = float(a @ (M @ a) + x @ (weights * x))  # twice, as the next two
        spare = (1.0 - scale * scale) * energy
        linear = float(scale * (da @ (M @ a) + dx @ (weights * x)))
        square = float(da @ (M @ da) + dx @ (weights * dx))
        if square + 2.0 * linear <= spare:
            way = 1.0
        else:
            root = math.sqrt(linear * linear + square * spare)
            way = spare / (linear + root) if linear > 0.0 else (root - linear) / square
    else:
        shift = np.zeros_like(a)
    keep = scale + way * (1.0 - scale)
    torque = np.minimum(np.maximum(keep * torque + way * cut, -limit), limit)
    return keep * a + way * shift, keep * x, torque, True


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
    G, half, trace = J @ J.T, J_dot @ J.T, np.trace(M)
    D, D_dot = damping(G, half + half.T, threshold)
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
    e2, F = threshold * threshold, np.zeros_like(G)
    # No eigenvalue is less than 1 / tr G^-1, which is found in a tenth of their time. The shift
    # keeps the inverse finite, and counts against it.
    shift = 1e-6 * e2
    if np.trace(np.linalg.inv(G + shift * np.eye(len(G)))) * (e2 + shift) < 1.0:
        return F, F
    g, U = np.linalg.eigh(G)
    below = np.maximum(e2 - g, 0.0)
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
