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
    """Kinematics of one frame, such as an end effector, at the current state.

    Attributes:
        frame: its name.
        v: velocity of the joints, shape (n,), rad/s.
        a_last: acceleration of the joints commanded last, shape (n,), rad/s^2.
        pose: placement in the root frame of the URDF.
        J: its Jacobian in its own axes, shape (6, n), linear rows first.
        drift: its acceleration at zero joint acceleration, J' v, shape (6,).
        J_dot: time derivative of J, shape (6, n).
    """

    def __init__(self, model: pin.Model, frame: str) -> None:
        self._frame_id = frame_id(model, frame)
        self.frame = frame
        self.v: Array = np.zeros(model.nv)
        self.a_last: Array = self.v
        self.pose = pin.SE3.Identity()
        self.J = np.zeros((6, model.nv))
        self.drift = np.zeros(6)
        self.J_dot = np.zeros((6, model.nv))

    def read(self, model: pin.Model, data: pin.Data) -> None:
        """Take pose, Jacobian and drift from `data`, which has the kinematics of the state."""
        frame = self._frame_id
        self.pose = pin.updateFramePlacement(model, data, frame)
        self.J = pin.getFrameJacobian(model, data, frame, _LOCAL)
        self.drift = pin.getFrameAcceleration(model, data, frame, _LOCAL).vector

    def read_rate(self, model: pin.Model, data: pin.Data) -> None:
        """Take the time derivative of the Jacobian from `data`."""
        self.J_dot = pin.getFrameJacobianTimeVariation(model, data, self._frame_id, _LOCAL)


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
        q: position, shape (n,), rad.
        others: the further end effectors.
        payload: that the masses of the model include.
        M: mass matrix in the middle of the step, shape (n, n), kg m^2.
        h: Coriolis, centrifugal and gravity torques there, shape (n,), N m.
        C: Coriolis matrix there, M' - 2 C skew-symmetric, shape (n, n), N m s; with `rates`.
        rates: whether `update` computes C and J_dot; else they are old.
        data: Pinocchio's; after `update` with the kinematics and joint Jacobians of the current
            state, at zero acceleration.

    Raises:
        RobotDescriptionError: no such frame.
    """

    def __init__(
        self, model: pin.Model, frame: str, dt: float, others: Sequence[str] = ()
    ) -> None:
        super().__init__(model, frame)
        self.others = tuple(FrameModel(model, each) for each in others)
        self.model = model
        self.payload = Payload(model)
        self.dt = dt
        self.n = model.nv
        self.data = model.createData()
        self._zero = np.zeros(self.n)
        self._middle = np.zeros(self.n), np.zeros(self.n)
        self.q: Array = self._zero
        self.M = np.eye(self.n)
        self.h = np.zeros(self.n)
        self.C = np.zeros((self.n, self.n))
        self.rates = False

    def update(self, state: State, a_last: Array) -> None:
        """Compute everything for one control step.

        Args:
            state: of the n joints.
            a_last: acceleration commanded last, shape (n,), rad/s^2.
        """
        model, data = self.model, self.data
        q, v = self.q, self.v = state
        self.a_last = a_last
        q_mid, v_mid = self._middle
        _middle_of_step(q, v, a_last, self.dt, q_mid, v_mid)
        self.M = pin.crba(model, data, q_mid)
        self.h = pin.nonLinearEffects(model, data, q_mid, v_mid)
        if self.rates:
            self.C = pin.computeCoriolisMatrix(model, data, q_mid, v_mid)
        # Last, because the kinematics in `data` are to be those of the current state.
        if self.rates:
            pin.computeJointJacobiansTimeVariation(model, data, q, v)
            self.read_rate(model, data)
            for hand in self.others:
                hand.read_rate(model, data)
        pin.forwardKinematics(model, data, q, v, self._zero)
        if not self.rates:
            pin.computeJointJacobians(model, data)  # of the positions in `data`
        self.read(model, data)
        for hand in self.others:
            hand.v, hand.a_last = v, a_last
            hand.read(model, data)

    def torque(self, a: Array, state: State | None = None) -> Array:
        """Return the torque that, held for dt, gives mean acceleration `a`, shape (n,), N m.

        From `state` on; None for the current one.
        """
        q, v = state or (self.q, self.v)
        q_mid, v_mid = self._middle
        _middle_of_step(q, v, a, self.dt, q_mid, v_mid)
        tau: Array = pin.rnea(self.model, self.data, q_mid, v_mid, a)
        return tau


@njit(cache=True)
def _middle_of_step(q: Array, v: Array, a: Array, dt: float, q_mid: Array, v_mid: Array) -> None:
    """Write position and velocity after dt / 2 at acceleration `a`, shape (n,) each."""
    half = 0.5 * dt
    for j in range(q.size):
        change = half * a[j]
        q_mid[j], v_mid[j] = q[j] + half * (v[j] + 0.5 * change), v[j] + change
