# SPDX-License-Identifier: Apache-2.0
"""Small dense linear algebra, compiled: for matrices of 7 columns NumPy is mostly overhead.

Each function is here because NumPy's way costs more than 3 % of a control step more
(`scripts/bench.sh step`).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

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
    # Cholesky's factor of J J' + regularisation I, row by row.
    L = np.empty((m, m))
    y = np.empty(m)
    for i in range(m):
        s = 0.0
        for k in range(n):
            s += J[i, k] * error[k]
        for j in range(i + 1):
            p = regularisation if i == j else 0.0
            for k in range(n):
                p += J[i, k] * J[j, k]
            for k in range(j):
                p -= L[i, k] * L[j, k]
            if i > j:
                L[i, j] = p / L[j, j]
                s -= L[i, j] * y[j]
            elif 0.0 < p < np.inf:
                L[i, i] = math.sqrt(p)
            else:
                return b
        y[i] = s / L[i, i]
    for i in range(m - 1, -1, -1):
        for k in range(i + 1, m):
            y[i] -= L[k, i] * y[k]
        y[i] /= L[i, i]
        for k in range(n):
            b[k] -= kp * J[i, k] * y[i]
    return b
