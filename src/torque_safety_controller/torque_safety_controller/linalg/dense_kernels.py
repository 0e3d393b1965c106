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
def spring_damper(J: Array, v: Array, error: Array, drift: Array, kp: float, kd: float) -> Array:
    """Return ``kp error - kd J v - drift``, shape (m,), J of shape (m, n)."""
    m, n = J.shape
    b = np.empty(m)
    for i in range(m):
        speed = 0.0
        for k in range(n):
            speed += J[i, k] * v[k]
        b[i] = kp * error[i] - kd * speed - drift[i]
    return b


@compiled
def apart(b: Array, twist: Array) -> Array:
    """Return `b`, accelerations less J'v, with the hand's origin accelerated for its twist's.

    The linear rows of J a + J'v are the rate of the velocity in axes that turn with w; the origin
    accelerates by w x v more. Shape (6,), linear first, both in the hand's axes.
    """
    result = b.copy()
    result[0] -= twist[4] * twist[2] - twist[5] * twist[1]
    result[1] -= twist[5] * twist[0] - twist[3] * twist[2]
    result[2] -= twist[3] * twist[1] - twist[4] * twist[0]
    return result


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
