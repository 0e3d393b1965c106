# SPDX-License-Identifier: Apache-2.0
"""Checks that the motors can brake an arm from every state the next step may reach.

`state_dependent_limits` lets joints be faster than the worst-case braking allows. That is safe as
long as there is a way out: a braking path, each joint slowing down at a constant rate from the
end of the step until it stands still, on which every motor stays within its torque limit. The
path is known, so that torque along it can be computed; only where the step ends is open, because
the controller chooses any acceleration in the interval that it is given. To first order, with
``rnea`` and its derivatives along the path from the middle of what can be reached,

    |tau_i| + sum_j |d tau_i / d q_j| dq_j + |d tau_i / d v_j| dv_j + |M_ij| da_j <= tau_max_i

for deviations dq, dv of the path and da of the rates near the moments at which joints stop.
`docs/state_dependent_limits.md` derives it and says what the reserve has to cover.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from viability_bounds_pkg.compiled import compiled

Array = NDArray[np.float64]

PIECE = 0.04
"""Longest piece of a braking path, s; torques are computed in the middle of each, and cover it to
first order in time."""
MOST_PIECES = 25


class Reach(NamedTuple):
    """The states in which a step may end, and how the arm brakes from there.

    Attributes:
        q: middle of the positions, shape (n,), rad.
        v: middle of the velocities, shape (n,), rad/s.
        dq: largest deviation from `q`, shape (n,), rad.
        dv: largest deviation from `v`, shape (n,), rad/s.
        braking: deceleration of each joint, shape (n,), rad/s^2, positive.
        horizon: when all joints stand still, s.
    """

    q: Array
    v: Array
    dq: Array
    dv: Array
    braking: Array
    horizon: float


class BrakingCertificate:
    """Checks braking paths of one arm against its torque limits.

    Args:
        model: n joints with one coordinate each.
        tau_max: torque that may be used, shape (n,), N m.
    """

    def __init__(self, model: pin.Model, tau_max: Array):
        self._model = model
        self._data = model.createData()
        self._tau_max = np.asarray(tau_max, dtype=float)
        n = model.nv
        # The path's q, v, a and the deviations of each, at each sample.
        self._path = np.zeros((MOST_PIECES, 6, n))

    def holds(self, reach: Reach) -> bool:
        """Return whether the torque limits allow the braking from every state reached."""
        pieces = min(1 + int(reach.horizon / PIECE), MOST_PIECES)
        path = self._path[:pieces]
        half_gap = 0.5 * reach.horizon / pieces
        _fill_path(*reach[:-1], half_gap, path)
        for q, v, a, dq, dv, da in path:
            # Every term is written to `data` in place.
            by_q, by_v, M = pin.computeRNEADerivatives(self._model, self._data, q, v, a)
            if not _within(
                self._data.tau, by_q, by_v, M, v, a, dq, dv, da, half_gap, self._tau_max
            ):
                return False
        return True


@compiled
def _fill_path(
    q: Array, v: Array, dq: Array, dv: Array, braking: Array, half_gap: float, path: Array
) -> None:
    """Fill in the states in the middle of equal pieces of a braking path, and their deviations.

    Within a piece a joint may stop, or begin to move the other way from the start: then any
    acceleration between braking and what comes after it is counted.
    """
    samples, n = path.shape[0], q.size
    for m in range(samples):
        t = (2 * m + 1) * half_gap
        for j in range(n):
            b, speed = braking[j], abs(v[j])
            direction = 1.0 if v[j] > 0.0 else -1.0
            stop = speed / b
            # The earliest and the latest end of braking, over all states in reach.
            slack = dv[j] / b + half_gap
            moving = min(t, stop)
            path[m, 0, j] = q[j] + direction * (speed - 0.5 * b * moving) * moving
            path[m, 1, j] = direction * (speed - b * moving)
            path[m, 2, j] = -direction * b if t < stop else 0.0
            path[m, 5, j] = 0.0
            path[m, 3, j] = dq[j] + dv[j] * min(t, stop + dv[j] / b)
            path[m, 4, j] = dv[j] if t < stop + slack else 0.0
            if t < stop + slack:
                if speed <= dv[j]:
                    # The direction is open: from braking one way to braking the other.
                    path[m, 2, j], path[m, 5, j] = 0.0, b
                elif t > stop - slack:
                    path[m, 2, j], path[m, 5, j] = -0.5 * direction * b, 0.5 * b


@compiled
def _within(
    tau: Array,
    by_q: Array,
    by_v: Array,
    M: Array,
    v: Array,
    a: Array,
    dq: Array,
    dv: Array,
    da: Array,
    half_gap: float,
    tau_max: Array,
) -> bool:
    """Return whether torques stay within limits around one sample of a path."""
    n = tau.size
    for i in range(n):
        spread = 0.0
        rate = 0.0
        for j in range(n):
            inertia = M[i, j] if i <= j else M[j, i]
            spread += abs(by_q[i, j]) * dq[j] + abs(by_v[i, j]) * dv[j] + abs(inertia) * da[j]
            rate += by_q[i, j] * v[j] + by_v[i, j] * a[j]
        # Written so that a NaN is a no.
        if not abs(tau[i]) + spread + abs(rate) * half_gap <= tau_max[i]:
            return False
    return True
