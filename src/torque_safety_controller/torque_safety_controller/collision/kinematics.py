"""Placements and motion of an arm's joints by Pinocchio, as arrays for compiled functions."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

Array = NDArray[np.float64]


class JointKinematics:
    """Joint placements, Jacobian and its rate at one state, in the root frame.

    Args:
        model: n joints with one coordinate each.

    Attributes:
        placements: of the joints, shape (n + 1, 4, 3): the rows of the rotation, then the origin,
            m; joint 0 is the root.
        J: spatial velocity of each joint about the root's origin for a unit joint velocity, shape
            (n, 2, 3): linear, then angular.
        dJ: its time derivative, shape (n, 2, 3).
    """

    def __init__(self, model: pin.Model) -> None:
        self._model = model
        self._data = model.createData()
        self.placements: Array = np.zeros((model.njoints, 4, 3))
        self._rows = self.placements.reshape(-1, 3)
        # Views of Pinocchio's memory: to read each placement anew takes ten times as long.
        self._views = [
            view
            for i in range(model.njoints)
            for view in (self._data.oMi[i].rotation, self._data.oMi[i].translation[None])
        ]
        self.J: Array = self._data.J.T.reshape(-1, 2, 3)
        self.dJ: Array = self._data.dJ.T.reshape(-1, 2, 3)

    def update(self, q: Array, v: Array) -> None:
        """Compute everything at a state of shapes (n,), rad, and (n,), rad/s."""
        pin.computeJointJacobiansTimeVariation(self._model, self._data, q, v)
        np.concatenate(self._views, out=self._rows)
