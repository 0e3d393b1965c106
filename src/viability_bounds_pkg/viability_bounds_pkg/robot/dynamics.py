# SPDX-License-Identifier: Apache-2.0
"""Dynamics of an arm with joints in any order, and the accelerations that its motors can give."""

from __future__ import annotations

from collections.abc import Sequence

import daqp
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from viability_bounds_pkg.joint_limits import JointLimitsError

Array = NDArray[np.float64]

STIFFNESS = 1000.0
"""How much a departure from the interval counts beside one from the wanted acceleration."""

_UNLIMITED = 1e30
"""Infinity of DAQP."""


class Dynamics:
    """Pinocchio's dynamics of an arm, arrays of shape (n,) in the order of the caller's joints.

    Args:
        model: the arm, one degree of freedom a joint; it may change.
        names: of its n joints, in the caller's order.

    Raises:
        JointLimitsError: other joints than those of the model.
    """

    def __init__(self, model: pin.Model, names: Sequence[str]) -> None:
        own = list(model.names)[1:]
        if sorted(own) != sorted(names) or model.nv != len(own):
            allowed = f"must be the joints of the model: {', '.join(own)}"
            raise JointLimitsError("names", None, list(names), allowed)
        self._model, self._data = model, model.createData()
        # Where the joints of the model are in the caller's arrays, and the other way round.
        self._order = np.array([names.index(name) for name in own])
        self._back = np.argsort(self._order)

    def torque(self, q: Array, v: Array, a: Array) -> Array:
        """Return the torques for accelerations, N m."""
        order = self._order
        tau: Array = pin.rnea(self._model, self._data, q[order], v[order], a[order])
        return tau[self._back]

    def acceleration(self, q: Array, v: Array, tau: Array) -> Array:
        """Return the accelerations by torques, rad/s^2."""
        order = self._order
        a: Array = pin.aba(self._model, self._data, q[order], v[order], tau[order])
        return a[self._back]

    def mass_matrix(self, q: Array) -> Array:
        """Return the symmetric mass matrix, shape (n, n), kg m^2."""
        M: Array = pin.crba(self._model, self._data, q[self._order])
        return M[np.ix_(self._back, self._back)]


def within_torque_limits(
    a: Array,
    lower: Array,
    upper: Array,
    scale: Array,
    M: Array,
    tau: Array,
    tau_min: Array,
    tau_max: Array,
) -> Array:
    """Return the accelerations nearest to `a` whose torques are within the limits.

    A quadratic program, solved by DAQP [Arnstrom2022],

        min  sum(x_i^2) + STIFFNESS sum(departure_i^2),   tau_min <= tau + M S x <= tau_max,

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
        tau_min: least torques, shape (n,), N m.
        tau_max: greatest torques, shape (n,), N m.

    Returns:
        Shape (n,), rad/s^2; `a` itself where DAQP finds nothing, as for numbers that are not
        finite.
    """
    n = a.size
    one, none = np.eye(n), np.zeros((n, n))
    unit = 0.5 * (tau_max - tau_min)
    rows = np.block([[one, -one], [M * (scale / unit[:, np.newaxis]), none]])
    high = np.concatenate([(upper - a) / scale, (tau_max - tau) / unit])
    low = np.concatenate([(lower - a) / scale, (tau_min - tau) / unit])
    x, _, flag, _ = daqp.solve(
        np.diag(np.repeat([1.0, STIFFNESS], n)),
        np.zeros(2 * n),
        rows,
        np.minimum(high, _UNLIMITED),
        np.maximum(low, -_UNLIMITED),
        np.zeros(2 * n, dtype=np.int32),
    )
    return a + scale * x[:n] if flag > 0 else a
