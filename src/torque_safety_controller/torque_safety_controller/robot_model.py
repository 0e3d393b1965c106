# SPDX-License-Identifier: Apache-2.0
"""One Pinocchio model of the arm; every quantity of a control step computed once."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pinocchio as pin
from numba import njit
from numpy.typing import NDArray

from viability_bounds_pkg.robot.description import frame_id
from viability_bounds_pkg.robot.payload import Payload
from viability_bounds_pkg.state import State

Array = NDArray[np.float64]
_LOCAL = pin.ReferenceFrame.LOCAL


class FrameModel:
    """Kinematics of one frame, such as an end effector, at the current state of an arm.

    Pose, Jacobian and drift are computed when one of them is read for the first time in a step.

    Args:
        robot: the arm.
        frame: name of the frame.

    Attributes:
        frame: as given.
        known: whether `pose`, `J` and `drift` are those of the current state.

    Raises:
        RobotDescriptionError: no such frame.
    """

    def __init__(self, robot: RobotModel, frame: str) -> None:
        self._robot, self._frame_id = robot, frame_id(robot.model, frame)
        self.frame, self.known = frame, False
        robot.frames.append(self)

    @property
    def pose(self) -> pin.SE3:
        """Placement in the root frame of the URDF."""
        if not self.known:
            self._read()
        return self._pose

    @property
    def J(self) -> Array:
        """Jacobian in the frame's own axes, shape (6, n), linear rows first."""
        if not self.known:
            self._read()
        return self._J

    @property
    def drift(self) -> Array:
        """Acceleration at zero joint acceleration, J' v, shape (6,)."""
        if not self.known:
            self._read()
        return self._drift

    @property
    def J_dot(self) -> Array:
        """Time derivative of J, shape (6, n), computed when it is read."""
        robot, data = self._robot, self._robot.data
        pin.computeJointJacobiansTimeVariation(robot.model, data, robot.q, robot.v)
        J_dot: Array = pin.getFrameJacobianTimeVariation(robot.model, data, self._frame_id, _LOCAL)
        return J_dot

    def _read(self) -> None:
        model, data, frame = self._robot.model, self._robot.data, self._frame_id
        self._pose = pin.updateFramePlacement(model, data, frame)
        self._J: Array = pin.getFrameJacobian(model, data, frame, _LOCAL)
        self._drift: Array = pin.getFrameAcceleration(model, data, frame, _LOCAL).vector
        self.known = True


class RobotModel(FrameModel):
    """Kinematics of the end effectors and dynamics of the arm at the current state.

    The dynamics are those in the middle of the control step that the torque will be held for,

        q_mid = q + v dt / 2 + a dt^2 / 8,    v_mid = v + a dt / 2,

    because the acceleration under a constant torque drifts: a torque right for the middle of
    the step gives the wanted change of velocity with an error of second order in dt, one for
    its beginning with an error of first order. `docs/theory/bounds.md` measures both. The
    acceleration a of the step is not known before the QP is solved; the last one stands in for
    it in `update`, and `torque` takes the one that was found.

    Args:
        model: n joints with one coordinate each.
        frame: name of the end-effector frame.
        dt: control period that torques are held for, s; 0 evaluates at the current state.
        others: names of the frames of further end effectors.

    Attributes:
        q: position, shape (n,), rad; a copy of the state's, and written again by each update.
        v: velocity, shape (n,), rad/s; likewise.
        a_last: acceleration commanded last, shape (n,), rad/s^2.
        others: the further end effectors.
        frames: all frames that follow the arm, itself the first.
        payload: that the masses of the model include.
        M: mass matrix in the middle of the step, shape (n, n), kg m^2.
        h: Coriolis, centrifugal and gravity torques there, shape (n,), N m.

    Raises:
        RobotDescriptionError: no such frame.
    """

    def __init__(
        self, model: pin.Model, frame: str, dt: float, others: Sequence[str] = ()
    ) -> None:
        self.model, self.dt, self.n = model, dt, model.nv
        self.frames: list[FrameModel] = []
        super().__init__(self, frame)
        self.others = tuple(FrameModel(self, each) for each in others)
        self.payload = Payload(model)
        self._zero = np.zeros(self.n)
        self.q, self.v, self.a_last = np.zeros(self.n), np.zeros(self.n), self._zero
        self._middle = np.zeros(self.n), np.zeros(self.n)
        self._held = np.zeros(self.n), np.zeros(self.n)
        # Apart, as what is computed of the middle of a step would overwrite its beginning.
        self._kinematics, self._dynamics = model.createData(), model.createData()
        self._placed = False
        self.M = np.eye(self.n)
        self.h = np.zeros(self.n)

    @property
    def data(self) -> pin.Data:
        """Pinocchio's, with kinematics and joint Jacobians of the state, at zero acceleration."""
        if not self._placed:
            pin.forwardKinematics(self.model, self._kinematics, self.q, self.v, self._zero)
            pin.computeJointJacobians(self.model, self._kinematics)  # of its positions
            self._placed = True
        return self._kinematics

    @property
    def C(self) -> Array:
        """Coriolis matrix in the middle of the step, computed when it is read.

        Shape (n, n), N m s; M' - 2 C is skew-symmetric.
        """
        C: Array = pin.computeCoriolisMatrix(self.model, self._dynamics, *self._middle)
        return C

    def update(self, state: State, a_last: Array) -> None:
        """Compute the dynamics of one control step; what follows the state is computed when read.

        Args:
            state: of the n joints.
            a_last: acceleration commanded last, shape (n,), rad/s^2.
        """
        self.a_last = a_last
        q_mid, v_mid = self._middle
        _middle_of_step(*state, a_last, self.dt, self.q, self.v, q_mid, v_mid)
        self.M = pin.crba(self.model, self._dynamics, q_mid)
        self.h = pin.nonLinearEffects(self.model, self._dynamics, q_mid, v_mid)
        self._placed = False
        for frame in self.frames:
            frame.known = False

    def torque(self, a: Array) -> Array:
        """Return the torque that, held for dt, gives mean acceleration `a`, shape (n,), N m."""
        q_mid, v_mid = self._held
        _middle_of_step(self.q, self.v, a, self.dt, self.q, self.v, q_mid, v_mid)
        tau: Array = pin.rnea(self.model, self._dynamics, q_mid, v_mid, a)
        return tau


@njit(cache=True)
def _middle_of_step(
    q: Array, v: Array, a: Array, dt: float, q_now: Array, v_now: Array, q_mid: Array, v_mid: Array
) -> None:
    """Copy the state, and write position and velocity after dt / 2 at `a`, shape (n,) each."""
    half = 0.5 * dt
    for j in range(q.size):
        change = half * a[j]
        q_now[j], v_now[j] = q[j], v[j]
        q_mid[j], v_mid[j] = q[j] + half * (v[j] + 0.5 * change), v[j] + change
