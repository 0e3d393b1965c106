# SPDX-License-Identifier: Apache-2.0
"""Inverse kinematics within position limits, step by step."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from torque_safety_controller.qp.daqp_solver import DaqpSolver
from torque_safety_controller.qp.quadratic_program import QuadraticProgram, Status
from torque_safety_controller.tasks.pose_task import pose_error
from torque_safety_controller.tasks.way_search import Search

Array = NDArray[np.float64]

ITERATIONS = 20
"""Steps from one posture to begin with."""

EXACT = 1e-5
"""Error that is taken for none, m and rad."""

FARTHEST = 0.8
"""Largest motion of a joint in a step, rad."""

DAMPING = 1e-2
"""Weight of the squared motion, as a share of the squared error: Levenberg and Marquardt."""

COST = 5
"""Of a step, as compared with one posture that is checked for whether it can be held."""


class PostureSearch:
    """Finds postures for a pose of the end effector.

    Args:
        model: the arm, n joints with one coordinate each.
        frame: name of the end-effector frame.
        low: lowest positions, shape (n,), rad; finite.
        high: highest, shape (n,), rad; finite.
    """

    def __init__(self, model: pin.Model, frame: str, low: Array, high: Array) -> None:
        self._model, self._data, self._frame = model, model.createData(), model.getFrameId(frame)
        self._low, self._high = low, high
        self._solver = DaqpSolver()

    def find(self, pose: pin.SE3, q: Array) -> Search[Array | None]:
        """Search from `q` on; return a posture, shape (n,), rad, or None.

        Each step is the motion dq within the limits that is best for the linearised error e,
        min |J dq - e|^2 + damping |e|^2 |dq|^2.

        Args:
            pose: of the end effector in the URDF's root frame.
            q: to begin with, shape (n,), rad.
        """
        model, data, n = self._model, self._data, q.size
        none = np.zeros((0, n))
        q = np.clip(q, self._low, self._high)
        for _ in range(ITERATIONS):
            pin.computeJointJacobians(model, data, q)
            J = pin.getFrameJacobian(model, data, self._frame, pin.ReferenceFrame.LOCAL)
            e = pose_error(pin.updateFramePlacement(model, data, self._frame), pose)
            size = float(e @ e)
            if np.abs(e).max() < EXACT:
                return q
            H = J.T @ J + (DAMPING * size + 1e-9) * np.eye(n)
            lower = np.maximum(self._low - q, -FARTHEST)
            upper = np.minimum(self._high - q, FARTHEST)
            step = self._solver.solve(QuadraticProgram(H, -e @ J, none, lower, upper))
            yield COST
            if step.status is not Status.SOLVED or np.abs(step.x).max() < 1e-6:
                return None
            q = q + step.x
        return None
