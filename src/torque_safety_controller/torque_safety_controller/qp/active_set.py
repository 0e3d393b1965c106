# SPDX-License-Identifier: Apache-2.0
"""The QP of a step, written and solved in one compiled call, if the limits active last still are.

Compiled, because it runs at every step and NumPy takes twenty times as long.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]

TOLERANCE = 1e-9
"""Violation of a limit, in its unit, that counts as none."""


@njit(cache=True)
def write_and_solve(
    H: Array,
    g: Array,
    C: Array,
    lower: Array,
    upper: Array,
    active: NDArray[np.int32],
    x: Array,
    gamma: float,
    a_lower: Array,
    a_upper: Array,
    M: Array,
    h: Array,
    tau_min: Array,
    tau_max: Array,
    A: Array,
    b: Array,
    weight: float,
    b_joints: Array,
    weight_joints: float,
) -> bool:
    """Write the program without constraints and forces; return whether x is its solution.

    The cost is ``(gamma |x|^2 + weight |A x - b|^2 + weight_joints |a - b_joints|^2) / 2``.

    Args:
        H: written, as the next ones: of a `QuadraticProgram` in x = (a, rho).
        g: shape (n + r,).
        C: shape (n + k, n + r); of it M.
        lower: shape (n + r + n + k,); of it the limits of a and M a.
        upper: same shape.
        active: 1 for upper limits, 3 for lower ones, else 0, shape (n + r + n + k,); what was
            active last, and, where x is the solution, what is.
        x: shape (n + r,), written.
        gamma: weight of |x|^2.
        a_lower: limits of a, shape (n,).
        a_upper: shape (n,).
        M: shape (n, n).
        h: shape (n,).
        tau_min: limits of M a + h, shape (n,).
        tau_max: shape (n,).
        A: shape (m, n + r).
        b: shape (m,).
        weight: of the difference of A x and b.
        b_joints: shape (n,).
        weight_joints: of the difference of a and this.
    """
    n, size, m = len(a_lower), len(g), len(b)
    for i in range(size):
        for j in range(i + 1):
            s = 0.0
            for k in range(m):
                s += A[k, i] * A[k, j]
            H[i, j] = H[j, i] = weight * s
        s = 0.0
        for k in range(m):
            s += A[k, i] * b[k]
        H[i, i] += gamma
        g[i] = -weight * s
    for i in range(n):
        if weight_joints > 0.0:
            H[i, i] += weight_joints
            g[i] -= weight_joints * b_joints[i]
        for j in range(n):
            C[i, j] = M[i, j]
        lower[i], upper[i] = a_lower[i], a_upper[i]
        lower[size + i], upper[size + i] = tau_min[i] - h[i], tau_max[i] - h[i]
    return solved_by(active, H, g, C, lower, upper, x)


@njit(cache=True)
def solved_by(
    active: NDArray[np.int32], H: Array, g: Array, C: Array, lower: Array, upper: Array, x: Array
) -> bool:
    """Return whether the solution of a program has these limits active; if so, write it to x.

    With the active limits as equalities A x = b it is

        (H, A'; A, 0) (x, lambda) = (-g, b).

    It is right if x is within all limits, and no multiplier pulls towards its own.
    """
    m, p = C.shape
    size = p + np.count_nonzero(active)
    if size > 2 * p:
        return False
    system = np.zeros((size, size + 1))
    system[:p, :p] = H
    system[:p, size] = -g
    row = p
    for i in range(p + m):
        if not lower[i] <= upper[i]:
            return False
        if active[i] != 0:
            if i < p:
                system[row, i] = system[i, row] = 1.0
            else:
                for j in range(p):
                    system[row, j] = system[j, row] = C[i - p, j]
            system[row, size] = upper[i] if active[i] == 1 else lower[i]
            row += 1
    if not _eliminated(system):
        return False
    multipliers, row = np.zeros(p + m), p
    for i in range(p + m):
        if active[i] != 0:
            multipliers[i] = system[row, size]
            row += 1
            if lower[i] < upper[i] and multipliers[i] * (2 - active[i]) < 0.0:
                return False
    for i in range(p):
        x[i] = system[i, size]
        if not lower[i] - TOLERANCE <= x[i] <= upper[i] + TOLERANCE:
            return False
    return clip_and_check(x, C, lower, upper, TOLERANCE, multipliers, active)


@njit(cache=True)
def _eliminated(system: Array) -> bool:
    """Solve A z = b, given as (A, b), by Gauss; z takes the place of b. False if A is singular."""
    n = len(system)
    for i in range(n):
        pivot = i
        for row in range(i + 1, n):
            if abs(system[row, i]) > abs(system[pivot, i]):
                pivot = row
        if system[pivot, i] == 0.0:
            return False
        for j in range(i, n + 1):
            system[i, j], system[pivot, j] = system[pivot, j], system[i, j]
        for row in range(i + 1, n):
            factor = system[row, i] / system[i, i]
            if factor != 0.0:
                for j in range(i + 1, n + 1):
                    system[row, j] -= factor * system[i, j]
    for i in range(n - 1, -1, -1):
        for j in range(i + 1, n):
            system[i, n] -= system[i, j] * system[j, n]
        system[i, n] /= system[i, i]
    return True


@njit(cache=True)
def clip_and_check(
    x: Array,
    C: Array,
    lower: Array,
    upper: Array,
    violation: float,
    multipliers: Array,
    sense: NDArray[np.int32],
) -> bool:
    """Clip x to its own limits, in place; return whether it and C x are finite and in limits.

    Args:
        x: shape (p,).
        C: shape (m, p).
        lower: of x, then of C x, shape (p + m,).
        upper: same shape.
        violation: that is allowed of the limits of C x.
        multipliers: shape (p + m,), > 0 where the upper limit is active, < 0 for the lower.
        sense: shape (p + m,), written: what is active, as DAQP takes it.
    """
    m, p = C.shape
    for i in range(p):
        if not (math.isfinite(x[i]) and lower[i] <= upper[i]):
            return False
        x[i] = min(max(x[i], lower[i]), upper[i])
    for i in range(m):
        value = 0.0
        for j in range(p):
            value += C[i, j] * x[j]
        low, high = lower[p + i] - violation, upper[p + i] + violation
        # So put that it is false where something is NaN.
        if not (math.isfinite(value) and low <= value <= high):
            return False
    for i in range(m + p):
        sense[i] = 1 if multipliers[i] > 0.0 else 3 if multipliers[i] < 0.0 else 0
    return True
