# SPDX-License-Identifier: Apache-2.0
"""The dynamically consistent inverse of a task Jacobian, and how it changes with time.

    J^+ = M^-1 J^T (J M^-1 J^T + c D)^-1,   c = n / tr M                            [Khatib1995]

Torques in the null space of its transpose do not accelerate the task. D damps the directions in
which J is nearly singular; it is exactly zero while all singular values of J are above a
threshold, and its derivative is continuous there (`singularity_damping`). With X = M^-1 J^T and
Y = J X + c D,

    X' = M^-1 (J'^T - M' X),   Y' = J' X + J X' + c D' + c' D,   (J^+)' = (X' - J^+ Y') Y^-1,

where J X' = (J' X)^T - X^T M' X. The damping leaves ``J J^+ = 1 - c D Y^-1``: identity in all
directions that are not damped.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from torque_safety_controller.linalg.cholesky import factorise, solve
from torque_safety_controller.linalg.singularity_damping import (
    damping,
    is_clear_of_singularities,
)
from viability_bounds_pkg.compiled import compiled

Array = NDArray[np.float64]

THRESHOLD = 0.03
"""Singular value of J below which its direction is damped."""


@compiled
def dynamically_consistent_inverse(
    J: Array, J_dot: Array, M: Array, M_dot: Array, threshold: float
) -> tuple[Array, Array]:
    """Return J^+ and its time derivative, shape (n, m) each.

    Args:
        J: Jacobian of the task, shape (m, n) with m < n.
        J_dot: its time derivative, shape (m, n).
        M: mass matrix, shape (n, n), kg m^2.
        M_dot: its time derivative, shape (n, n); C + C^T with Pinocchio's Coriolis matrix.
        threshold: singular value of J below which its direction is damped, in units of J. Rows
            of different units can be scaled to like size before; that changes the damping only.

    Raises:
        LinAlgError: M is not positive definite, or there are numbers that are not finite.
    """
    L = M.copy()
    if not factorise(L):
        raise np.linalg.LinAlgError("M is not positive definite")
    X = J.T.copy()
    solve(L, X)
    M_dot_X, J_dot_X = M_dot @ X, J_dot @ X
    Y, Y_dot = J @ X, J_dot_X + J_dot_X.T - X.T @ M_dot_X
    G = J @ J.T
    if not is_clear_of_singularities(G, threshold):
        half = J_dot @ J.T
        D, D_dot = damping(G, half + half.T, threshold)
        trace = np.trace(M)
        scale = len(M) / trace
        Y += scale * D
        Y_dot += scale * (D_dot - np.trace(M_dot) / trace * D)
    if not factorise(Y):
        raise np.linalg.LinAlgError("J M^-1 J^T is not positive definite")
    # Y and Y_dot are symmetric, so J^+ = X Y^-1 is the transpose of Y^-1 X^T.
    J_plus = X.T.copy()
    solve(Y, J_plus)
    X_dot = J_dot.T - M_dot_X
    solve(L, X_dot)
    J_plus_dot = (X_dot - J_plus.T @ Y_dot).T.copy()
    solve(Y, J_plus_dot)
    return J_plus.T.copy(), J_plus_dot.T.copy()
