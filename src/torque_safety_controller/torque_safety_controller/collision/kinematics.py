# SPDX-License-Identifier: Apache-2.0
"""Placements and motion of an arm's joints by Pinocchio, as arrays for compiled functions."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from torque_safety_controller.collision.kernels import ArmMotion

Array = NDArray[np.float64]


class Kinematics:
    """Joint placements, Jacobian and its rate at one state.

    Args:
        model: n joints with one coordinate each.
        bodies: how many bodies the joints move.

    Attributes:
        motion: placements, J and dJ are computed here, the rest by the kernels.
    """

    def __init__(self, model: pin.Model, bodies: int) -> None:
        self._model, self._data = model, model.createData()
        data, joints = self._data, model.njoints
        self.motion = ArmMotion(
            parent=np.array(list(model.parents), dtype=np.int64),
            placements=np.zeros((joints, 4, 3)),
            J=data.J.T.reshape(-1, 2, 3),  # views of Pinocchio's memory, like the two below
            dJ=data.dJ.T.reshape(-1, 2, 3),
            velocity=np.zeros((joints, 2, 3)),
            bias=np.zeros((joints, 2, 3)),
            rotation=np.zeros((bodies, 3, 3)),
            centre=np.zeros((bodies, 3)),
        )
        self._rows = self.motion.placements.reshape(-1, 3)
        # To read each placement anew takes ten times as long.
        self._views = [
            view
            for i in range(joints)
            for view in (data.oMi[i].rotation, data.oMi[i].translation[None])
        ]

    def update(self, q: Array, v: Array) -> None:
        """Compute the joints' part of `motion` at positions and velocities of shape (n,)."""
        pin.computeJointJacobiansTimeVariation(self._model, self._data, q, v)
        np.concatenate(self._views, out=self._rows)
