# SPDX-License-Identifier: Apache-2.0
"""A real arm with a task of some rows, for tests of what acts in a task and its null space."""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from arms import load_arm

from torque_safety_controller.integral_feedback import ArmTerms
from viability_bounds_pkg.robot.description import build_model
from viability_bounds_pkg.robot.files import read_urdf

_TALOS = "package://example-robot-data/robots/talos_data/robots/talos_reduced.urdf"
_TALOS_JOINTS = ["torso_1_joint", "torso_2_joint"] + [f"arm_left_{i}_joint" for i in range(1, 8)]
_POSTURES = {
    "panda": [0.3, 0.4, 0.2, -1.6, 0.1, 2.0, 0.5],
    "talos": [0.0, 0.1, 0.4, 0.5, -0.3, -1.5, 0.2, 0.1, 0.1],
}


class Terms(NamedTuple):
    """What a step needs: shapes (n, n), (n, n), (n,), (m, n), (m, n)."""

    M: np.ndarray
    C: np.ndarray
    h: np.ndarray
    J: np.ndarray
    J_dot: np.ndarray


def arm_terms(terms: Terms, v: np.ndarray) -> ArmTerms:
    """Return what integral actions need of the terms at velocity `v`."""
    J, J_dot = terms.J, terms.J_dot
    return ArmTerms(*(np.ascontiguousarray(x) for x in (terms.M, terms.C, J, J_dot, v)))


class TaskArm:
    """An arm, its hand and, for tasks of more than 6 rows, the position of its elbow.

    Args:
        robot: ``panda``, or ``talos`` for its torso and left arm, 9 joints.
        rows: of the task.
        armature: reflected inertia of each rotor, kg m^2.
    """

    def __init__(self, robot: str, rows: int = 6, armature: float = 0.0) -> None:
        model, frame = _model(robot)
        self.model = model.copy()
        self.model.armature = np.full(model.nv, armature)
        self.rows, self.n = rows, model.nv
        self.posture = np.array(_POSTURES[robot])
        self._hand = model.getFrameId(frame)
        self.elbow = model.nv - 3
        self._data = self.model.createData()

    def terms(self, q: np.ndarray, v: np.ndarray) -> Terms:
        """Return dynamics and the task's Jacobian with its derivative."""
        model, data = self.model, self._data
        M = pin.crba(model, data, q).copy()
        h = pin.nonLinearEffects(model, data, q, v).copy()
        C = pin.computeCoriolisMatrix(model, data, q, v).copy()
        pin.computeJointJacobiansTimeVariation(model, data, q, v)
        pin.updateFramePlacements(model, data)
        J, J_dot = (np.vstack(x) for x in zip(self._hand_rows(), self._elbow_rows(), strict=True))
        return Terms(M, C, h, J[: self.rows].copy(), J_dot[: self.rows].copy())

    def hand(self, q: np.ndarray) -> pin.SE3:
        """Return where the hand is."""
        pin.framesForwardKinematics(self.model, self._data, q)
        return self._data.oMf[self._hand].copy()

    def push(self, q: np.ndarray, force: np.ndarray) -> np.ndarray:
        """Return the joint torques of a force on the elbow, in world axes."""
        data = self._data
        J = pin.computeJointJacobians(self.model, data, q)
        J = pin.getJointJacobian(self.model, data, self.elbow, pin.LOCAL_WORLD_ALIGNED)
        return J[:3].T @ force

    def move(
        self, q: np.ndarray, v: np.ndarray, tau: np.ndarray, dt: float, friction: float = 0.0
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the state after dt under a constant torque and viscous friction, N m s/rad."""

        def a(q, v):
            return pin.aba(self.model, self._data, q, v, tau - friction * v)

        k1 = a(q, v)
        k2 = a(q + 0.5 * dt * v, v + 0.5 * dt * k1)
        k3 = a(q + 0.5 * dt * (v + 0.5 * dt * k1), v + 0.5 * dt * k2)
        k4 = a(q + dt * (v + 0.5 * dt * k2), v + dt * k3)
        return (
            q + dt * v + dt * dt * (k1 + k2 + k3) / 6.0,
            v + dt * (k1 + 2.0 * k2 + 2.0 * k3 + k4) / 6.0,
        )

    def _hand_rows(self):
        for function in (pin.getFrameJacobian, pin.getFrameJacobianTimeVariation):
            yield function(self.model, self._data, self._hand, pin.LOCAL)

    def _elbow_rows(self):
        for function in (pin.getJointJacobian, pin.getJointJacobianTimeVariation):
            yield function(self.model, self._data, self.elbow, pin.LOCAL)[:3]


@cache
def _model(robot: str) -> tuple[pin.Model, str]:
    if robot == "talos":
        return build_model(read_urdf(_TALOS), _TALOS_JOINTS), "gripper_left_base_link"
    arm = load_arm(robot)
    return arm.model, arm.frame
