# SPDX-License-Identifier: Apache-2.0
"""Mass matrices over an arm's postures, and how they couple the loops of its joints."""

from __future__ import annotations

import math

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

Array = NDArray[np.float64]

_POSTURES, _SEED = 200, 0


class ArmInertia:
    """Mass matrices of an arm at random postures within its position limits.

    With M = D^(1/2) Q S^-1 Q' D^(1/2), D = diag(M), the torque M a_ref + lambda D s falls apart
    into n loops of one joint each, which differ in the gain of the integral action only: lambda
    times a number of S. The numbers 1 / S are at least 0 and n in the mean over 1: coupled joints
    have some far above 1.

    Args:
        model: n joints with one coordinate each.
        q_min: lower position limits, shape (n,), rad; perhaps infinite.
        q_max: upper ones, shape (n,), rad.

    Attributes:
        matrices: M, shape (N, n, n), kg m^2.
        factors: smallest and largest number of S anywhere.
        diagonal: largest inertia of each joint, shape (n,), kg m^2.
    """

    def __init__(self, model: pin.Model, q_min: Array, q_max: Array) -> None:
        low, high = np.maximum(q_min, -math.pi), np.minimum(q_max, math.pi)
        data, random = model.createData(), np.random.default_rng(_SEED)
        self.matrices = np.array(
            [pin.crba(model, data, random.uniform(low, high)).copy() for _ in range(_POSTURES)]
        )
        diagonals = np.diagonal(self.matrices, axis1=1, axis2=2)
        self.diagonal: Array = diagonals.max(axis=0)
        scale = 1.0 / np.sqrt(diagonals)
        shares = np.linalg.eigvalsh(self.matrices * scale[:, :, None] * scale[:, None, :])
        self.factors = 1.0 / float(shares.max()), 1.0 / float(shares.min())
