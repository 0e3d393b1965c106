"""Generalised inverses of a task Jacobian, and how they change with time.

Both are ``J^+ = W^-1 J^T (J W^-1 J^T + c D)^-1``: the pseudo-inverse with W = 1, c = 1, the
dynamically consistent inverse [Khatib1995] with W = M, c = n / tr M. D damps the directions in
which J is nearly singular; it is exactly zero while all singular values of J are above a
threshold, and its derivative is continuous there (`singularity_damping`). With X = W^-1 J^T and
Y = J X + c D,

    X' = W^-1 (J'^T - W' X),   Y' = J' X + J X' + c D' + c' D,   (J^+)' = (X' - J^+ Y') Y^-1.

The damping leaves ``J J^+ = 1 - c D Y^-1``: identity in all directions that are not damped.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from torque_safety_controller.linalg.cholesky import factorise, solve_columns
from torque_safety_controller.linalg.singularity_damping import (
    damping,
    is_clear_of_singularities,
)
from viability_bounds_pkg.compiled import compiled
from viability_bounds_pkg.exceptions import ArmSafetyError

THRESHOLD = 0.03
"""Singular value of J below which its direction is damped, unless told otherwise."""

NOT_POSITIVE_DEFINITE, REGULAR, DAMPED = 0, 1, 2


class GeneralizedInverse(NamedTuple):
    """A generalised inverse and its derivative.

    Attributes:
        J_plus: shape (n, m).
        J_plus_dot: its time derivative, shape (n, m).
        damped: whether J is so near to a singularity that some direction is damped.
    """

    J_plus: np.ndarray
    J_plus_dot: np.ndarray
    damped: bool


class GeneralizedInverseError(ArmSafetyError, ValueError):
    """A Jacobian or mass matrix that has no such inverse."""


def pseudo_inverse(
    J: np.ndarray, J_dot: np.ndarray, threshold: float = THRESHOLD
) -> GeneralizedInverse:
    """Return ``J^T (J J^T + D)^-1``, the inverse of Moore and Penrose, and its derivative.

    Args:
        J: Jacobian of the task, shape (m, n) with m < n.
        J_dot: its time derivative, shape (m, n).
        threshold: singular value of J below which its direction is damped, in units of J. Rows
            of different units can be scaled to like size before; that changes the damping only.

    Raises:
        GeneralizedInverseError: a shape does not fit, `threshold` is not positive, or there
            are numbers that are not finite.
    """
    identity = np.eye(np.shape(J)[-1])
    return _inverse(J, J_dot, identity, np.zeros_like(identity), False, threshold)


def dynamically_consistent_inverse(
    J: np.ndarray,
    J_dot: np.ndarray,
    M: np.ndarray,
    M_dot: np.ndarray,
    threshold: float = THRESHOLD,
) -> GeneralizedInverse:
    """Return ``M^-1 J^T (J M^-1 J^T + c D)^-1`` and its derivative.

    Torques in the null space of its transpose do not accelerate the task.

    Args:
        J: Jacobian of the task, shape (m, n) with m < n.
        J_dot: its time derivative, shape (m, n).
        M: mass matrix, shape (n, n), kg m^2.
        M_dot: its time derivative, shape (n, n); C + C^T with Pinocchio's Coriolis matrix.
        threshold: as for `pseudo_inverse`, and of J too, so that it means the same.

    Raises:
        GeneralizedInverseError: as for `pseudo_inverse`, or M is not positive definite.
    """
    return _inverse(J, J_dot, M, M_dot, True, threshold)


def check_task_shape(m: int, n: int) -> None:
    """Raise `GeneralizedInverseError` unless a task of m rows leaves n joints a null space."""
    if not 0 < m < n:
        raise GeneralizedInverseError(
            f"a task of {m} rows for {n} joints; null-space compliance needs 1 to {n - 1} rows"
        )


def check_threshold(threshold: float) -> None:
    """Raise `GeneralizedInverseError` unless `threshold` is a positive number."""
    if not 0.0 < threshold < np.inf:
        raise GeneralizedInverseError(f"threshold = {threshold!r}, must be positive and finite")


def _inverse(J, J_dot, M, M_dot, weighted: bool, threshold: float) -> GeneralizedInverse:
    J, J_dot, M, M_dot = (np.ascontiguousarray(x, dtype=float) for x in (J, J_dot, M, M_dot))
    if J.ndim != 2 or J_dot.shape != J.shape:
        raise GeneralizedInverseError(
            f"J {J.shape} and J_dot {J_dot.shape} must both have shape (m, n)"
        )
    m, n = J.shape
    check_task_shape(m, n)
    check_threshold(threshold)
    if M.shape != (n, n) or M_dot.shape != (n, n):
        raise GeneralizedInverseError(
            f"M {M.shape} and M_dot {M_dot.shape} must both have shape ({n}, {n})"
        )
    J_plus, J_plus_dot = np.empty((n, m)), np.empty((n, m))
    outcome = generalized_inverse(
        J, J_dot, M, M_dot, weighted, True, threshold, J_plus, J_plus_dot
    )
    if outcome == NOT_POSITIVE_DEFINITE or not np.isfinite(J_plus_dot).all():
        raise GeneralizedInverseError("M is not positive definite, or not all numbers are finite")
    return GeneralizedInverse(J_plus, J_plus_dot, outcome == DAMPED)


@compiled
def generalized_inverse(
    J: np.ndarray,
    J_dot: np.ndarray,
    M: np.ndarray,
    M_dot: np.ndarray,
    weighted: bool,
    with_derivative: bool,
    threshold: float,
    J_plus: np.ndarray,
    J_plus_dot: np.ndarray,
) -> int:
    """Compute a generalised inverse: the compiled part, with nothing checked.

    Args:
        J: shape (m, n).
        J_dot: shape (m, n).
        M: shape (n, n).
        M_dot: shape (n, n).
        weighted: dynamically consistent; else the pseudo-inverse, and M is not looked at.
        with_derivative: whether to compute the derivative; else J_dot and M_dot are not used.
        threshold: singular value of J below which its direction is damped.
        J_plus: shape (n, m), receives the inverse.
        J_plus_dot: shape (n, m), receives its derivative.

    Returns:
        `NOT_POSITIVE_DEFINITE` (nothing was computed), `REGULAR` or `DAMPED`.
    """
    m, n = J.shape
    X, X_dot = np.empty((n, m)), np.empty((n, m))
    G = np.empty((m, m))
    for i in range(m):
        for k in range(n):
            X[k, i] = J[i, k]
        for j in range(i + 1):
            s = 0.0
            for k in range(n):
                s += J[i, k] * J[j, k]
            G[i, j] = s
            G[j, i] = s
    scale, scale_dot = 1.0, 0.0
    if weighted:
        L = M.copy()
        if not factorise(L):
            return NOT_POSITIVE_DEFINITE
        solve_columns(L, X)
        trace, trace_dot = 0.0, 0.0
        for k in range(n):
            trace += M[k, k]
            trace_dot += M_dot[k, k]
        scale = n / trace
        scale_dot = -scale * trace_dot / trace
    if with_derivative:
        for k in range(n):
            for i in range(m):
                s = J_dot[i, k]
                if weighted:
                    for r in range(n):
                        s -= M_dot[k, r] * X[r, i]
                X_dot[k, i] = s
        if weighted:
            solve_columns(L, X_dot)

    Y, Y_dot = np.empty((m, m)), np.empty((m, m))
    for i in range(m):
        for j in range(i + 1):
            s = 0.0
            for k in range(n):
                s += J[i, k] * X[k, j]
            Y[i, j] = s
            Y[j, i] = s
    if with_derivative:
        for i in range(m):
            for j in range(m):
                s = 0.0
                for k in range(n):
                    s += J_dot[i, k] * X[k, j] + J[i, k] * X_dot[k, j]
                Y_dot[i, j] = s
    outcome = REGULAR
    if not is_clear_of_singularities(G, threshold):
        outcome = DAMPED
        G_dot = np.zeros((m, m))
        if with_derivative:
            for i in range(m):
                for j in range(m):
                    s = 0.0
                    for k in range(n):
                        s += J_dot[i, k] * J[j, k] + J[i, k] * J_dot[j, k]
                    G_dot[i, j] = s
        D, D_dot = damping(G, G_dot, threshold)
        for i in range(m):
            for j in range(m):
                Y[i, j] += scale * D[i, j]
                Y_dot[i, j] += scale * D_dot[i, j] + scale_dot * D[i, j]
    if not factorise(Y):
        return NOT_POSITIVE_DEFINITE

    # Y^-1 X^T, whose rows are the columns of the inverse.
    columns = np.ascontiguousarray(X.T)
    solve_columns(Y, columns)
    J_plus[:] = columns.T
    if with_derivative:
        for i in range(m):
            for k in range(n):
                s = X_dot[k, i]
                for j in range(m):
                    s -= J_plus[k, j] * Y_dot[j, i]
                columns[i, k] = s
        solve_columns(Y, columns)
        J_plus_dot[:] = columns.T
    return outcome
