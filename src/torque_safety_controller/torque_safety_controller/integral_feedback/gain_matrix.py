# SPDX-License-Identifier: Apache-2.0
"""The gain K of the integral action: lambda diag(M), or lambda M.

[Benallegue2021] allows any positive definite K and takes lambda diag(M). With that, (11) is the
clip of each component by itself; with lambda M it is not.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from torque_safety_controller.integral_feedback.settings import PAPER_MASS, Law
from viability_bounds_pkg.compiled import compiled

Array = NDArray[np.float64]


@compiled
def gain_torque(law: Law, M: Array, s: Array) -> Array:
    """Return K s, shape (n,), N m, for the mass matrix M, shape (n, n), and s, shape (n,)."""
    if law.method == PAPER_MASS:
        return law.gain * (M @ s)
    return law.gain * np.diag(M) * s


@compiled
def gain_matrix(law: Law, M: Array) -> Array:
    """Return K, shape (n, n), N m s, for the mass matrix M, shape (n, n)."""
    if law.method == PAPER_MASS:
        return law.gain * M
    return law.gain * np.diag(np.diag(M))
