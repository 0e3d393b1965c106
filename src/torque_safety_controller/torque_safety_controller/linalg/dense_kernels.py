# SPDX-License-Identifier: Apache-2.0
"""Small dense linear algebra: for matrices of 7 columns NumPy is mostly overhead.

A function is compiled where NumPy's way costs more than 3 % of a control step more
(`scripts/bench.sh step`).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from torque_safety_controller.linalg.cholesky import factorise, solve
from viability_bounds_pkg.compiled import compiled

Array = NDArray[np.float64]


@compiled
def middle_of_step(q: Array, v: Array, a: Array, dt: float) -> tuple[Array, Array]:
    """Return position and velocity after dt / 2 at acceleration `a`, shape (n,) each."""
    half = 0.5 * dt
    q_mid, v_mid = np.empty(len(q)), np.empty(len(q))
    for i in range(len(q)):
        q_mid[i] = q[i] + half * (v[i] + 0.5 * half * a[i])
        v_mid[i] = v[i] + half * a[i]
    return q_mid, v_mid


@compiled
def null_space_spring_damper(
    J: Array, q_des: Array, q: Array, v: Array, kp: float, kd: float, regularisation: float
) -> Array:
    """Return ``kp N (q_des - q) - kd v``, shape (n,), with N the projector on J's null space.

    ``N = I - J' (J J' + regularisation I)^-1 J``, J of shape (m, n); I where J is not finite.
    """
    m, n = J.shape
    error = q_des - q
    b = kp * error - kd * v
    A, y = regularisation * np.eye(m), np.zeros((m, 1))
    for i in range(m):
        for k in range(n):
            y[i, 0] += J[i, k] * error[k]
            for j in range(i + 1):
                A[i, j] += J[i, k] * J[j, k]
    if factorise(A):
        solve(A, y)
        for i in range(m - 1, -1, -1):
            for k in range(n):
                b[k] -= kp * J[i, k] * y[i, 0]
    return b
