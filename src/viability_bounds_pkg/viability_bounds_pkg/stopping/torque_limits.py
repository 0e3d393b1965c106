# SPDX-License-Identifier: Apache-2.0
"""The accelerations nearest to those wanted that the motors can give."""

from __future__ import annotations

import daqp
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

STIFFNESS = 1000.0
"""How much a departure from the interval counts beside one from the wanted acceleration."""

_UNLIMITED = 1e30
"""Infinity of DAQP."""


def within_torque_limits(
    a: Array, lower: Array, upper: Array, scale: Array, M: Array, tau: Array, tau_max: Array
) -> Array:
    """Return the accelerations nearest to `a` whose torques are within the limits.

    A quadratic program, solved by DAQP [Arnstrom2022],

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

    Returns:
        Shape (n,), rad/s^2; `a` itself where DAQP finds nothing, as for numbers that are not
        finite.
    """
    n = a.size
    one, none = np.eye(n), np.zeros((n, n))
    rows = np.block([[one, -one], [M * (scale / tau_max[:, np.newaxis]), none]])
    share = tau / tau_max
    high = np.concatenate([(upper - a) / scale, 1.0 - share])
    low = np.concatenate([(lower - a) / scale, -1.0 - share])
    x, _, flag, _ = daqp.solve(
        np.diag(np.repeat([1.0, STIFFNESS], n)),
        np.zeros(2 * n),
        rows,
        np.minimum(high, _UNLIMITED),
        np.maximum(low, -_UNLIMITED),
        np.zeros(2 * n, dtype=np.int32),
    )
    return a + scale * x[:n] if flag > 0 else a
