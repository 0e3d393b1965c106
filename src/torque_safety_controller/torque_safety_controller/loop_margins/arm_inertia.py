# SPDX-License-Identifier: Apache-2.0
"""What the inertia of an arm makes of gains, over its postures."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

Array = NDArray[np.float64]

_POSTURES = 200
_SEED = 0


@dataclass(frozen=True, eq=False)
class ArmInertia:
    """Mass matrices at random postures.

    With M = D^(1/2) Q S^-1 Q' D^(1/2), D = diag(M), the torque M a_ref + lambda D s falls apart
    into n loops of one joint each, which differ in the gain of the integral action only: lambda
    times a number of S. The numbers 1 / S are at least 0 and n in the mean over 1: coupled joints
    have some far above 1.

    Attributes:
        matrices: M, shape (N, n, n), kg m^2.
        factors: smallest and largest number of S anywhere.
    """

    matrices: Array
    factors: tuple[float, float]

    @staticmethod
    def of(model: pin.Model, q_min: Array, q_max: Array) -> ArmInertia:
        """Return that of a model at postures within position limits.

        Args:
            model: n joints with one coordinate each.
            q_min: lower position limits, shape (n,), rad; perhaps infinite.
            q_max: upper ones, shape (n,), rad.
        """
        low, high = np.maximum(q_min, -math.pi), np.minimum(q_max, math.pi)
        data, random = model.createData(), np.random.default_rng(_SEED)
        matrices = np.empty((_POSTURES, model.nv, model.nv))
        for M in matrices:
            M[:] = pin.crba(model, data, random.uniform(low, high))
        scale = 1.0 / np.sqrt(np.diagonal(matrices, axis1=1, axis2=2))
        shares = np.linalg.eigvalsh(matrices * scale[:, :, None] * scale[:, None, :])
        return ArmInertia(matrices, (1.0 / float(shares.max()), 1.0 / float(shares.min())))

    def torque(self, accelerations: Array) -> Array:
        """Return the largest torques of accelerations of any signs, shape (n,), N m.

        Args:
            accelerations: their sizes, shape (n,), rad/s^2.
        """
        largest: Array = (np.abs(self.matrices) @ accelerations).max(axis=0)
        return largest

    @property
    def diagonal(self) -> Array:
        """Largest inertia of each joint, shape (n,), kg m^2."""
        largest: Array = np.diagonal(self.matrices, axis1=1, axis2=2).max(axis=0)
        return largest
