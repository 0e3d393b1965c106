# SPDX-License-Identifier: Apache-2.0
"""The accelerations nearest to those wanted that the motors can give."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from viability_bounds_pkg.compiled import compiled

Array = NDArray[np.float64]

ROUNDS = 500
"""Largest number of passes over all limits."""

ACCURACY = 1e-9
"""Change in a pass, as a share of an acceleration limit, at which the iteration ends."""

STIFFNESS = 1000.0
"""How much a departure from the interval counts beside one from the wanted acceleration."""


@compiled(error_model="numpy")
def within_torque_limits(
    a: Array, lower: Array, upper: Array, scale: Array, M: Array, tau: Array, tau_max: Array
) -> Array:
    """Return the accelerations nearest to `a` whose torques are within the limits.

    Hildreth's method, Gauss-Seidel on the dual, for

        min  sum(x_i^2) + STIFFNESS sum(departure_i^2),   abs(tau + M S x) <= tau_max,

    with accelerations ``a + S x``, S the diagonal matrix of `scale`, and the departure of an
    acceleration from [lower, upper], in units of its scale. The torque limits are hard, the
    intervals give way where both cannot be.

    Args:
        a: accelerations wanted, within the intervals, shape (n,), rad/s^2.
        lower: lower ends of the intervals, shape (n,), rad/s^2.
        upper: upper ends, shape (n,), rad/s^2.
        scale: unit of each acceleration, shape (n,), rad/s^2.
        M: mass matrix, shape (n, n), kg m^2.
        tau: torques for `a`, shape (n,), N m.
        tau_max: torque limits, shape (n,), N m.
    """
    n = len(a)
    rows, size = np.empty((n, n)), np.empty(n)
    for i in range(n):
        size[i] = 0.0
        for j in range(n):
            rows[i, j] = M[i, j] * scale[j] / tau_max[i]
            size[i] += rows[i, j] * rows[i, j]
    x, torque_multiplier, interval_multiplier = np.zeros(n), np.zeros(n), np.zeros(n)
    for _ in range(ROUNDS):
        change = 0.0
        for i in range(n):
            share = tau[i] / tau_max[i] + size[i] * torque_multiplier[i]
            for j in range(n):
                share += rows[i, j] * x[j]
            y = (share - min(max(share, -1.0), 1.0)) / size[i]
            step = y - torque_multiplier[i]
            torque_multiplier[i] = y
            for j in range(n):
                x[j] -= step * rows[i, j]
                change = max(change, abs(step * rows[i, j]))
        for i in range(n):
            free = x[i] + interval_multiplier[i]
            low, high = (lower[i] - a[i]) / scale[i], (upper[i] - a[i]) / scale[i]
            y = (free - min(max(free, low), high)) / (1.0 + 1.0 / STIFFNESS)
            change = max(change, abs(y - interval_multiplier[i]))
            x[i] -= y - interval_multiplier[i]
            interval_multiplier[i] = y
        if change < ACCURACY:
            break
    result: Array = a + scale * x
    return result
