# SPDX-License-Identifier: Apache-2.0
"""The task that brings the end effector to a pose.

The error of a pose is taken as one or apart, `PoseTask.separate`. As one it is the logarithm of
SE(3): the twist that leads to the goal in unit time, along a screw. Apart, (7) and (8) of
[Benallegue2021],

    p'' = kp (p_d - p) + kd (p_d' - p') + p_d'',   w' = kp log(R_d R') + kd (w_d - w) + w_d',

in the axes of the root: the origin of the hand goes straight to its goal however the hand turns
meanwhile. Near the goal both are the same.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from numba import njit
from numpy.typing import NDArray

from torque_safety_controller.qp import TaskTerm
from torque_safety_controller.robot_model import FrameModel, RobotModel

Array = NDArray[np.float64]

_ALL = np.ones(6)


class PoseMotion(NamedTuple):
    """How a goal pose moves, in its own axes."""

    twist: Array
    """Shape (6,), m/s and rad/s."""
    twist_rate: Array
    """Its time derivative, shape (6,)."""


@dataclass(slots=True)
class PoseTask:
    """Brings the end effector to a pose: eq. (34) of [DelPrete2018] with either error.

    Attributes:
        pose_des: goal in the URDF's root frame.
        kp: stiffness, 1/s^2.
        kd: damping, 1/s.
        weight: of the squared error of acceleration.
        motion: of the goal; None for one at rest.
        stiffness: share of `kp` in each of the end effector's axes, shape (6,); None for all.
        error_max: sizes at which the error of translation, m, and that of rotation, rad, count
            at most, so that a far goal is approached at no more than kp / kd times them.
        separate: whether position and orientation count apart, (7)-(8) of [Benallegue2021]; else
            their error is the logarithm of SE(3).
        hand: index in `RobotModel.others` of a further end effector; None for the first one.
    """

    pose_des: pin.SE3
    kp: float
    kd: float
    weight: float
    motion: PoseMotion | None = None
    stiffness: Array | None = None
    error_max: tuple[float, float] = (math.inf, math.inf)
    separate: bool = False
    hand: int | None = None

    def term(self, robot: RobotModel) -> TaskTerm:
        """Return ``J a = kp error - kd J v - J' v + feedforward`` as a term of the cost."""
        frame: FrameModel = robot if self.hand is None else robot.others[self.hand]
        pose, J, b = frame.pose, frame.J, np.empty(6)
        between = pose.actInv(self.pose_des)
        _spring_and_damper(
            pin.SE3ToXYZQUAT(between) if self.separate else pin.log6(between).vector,
            self.kp,
            self.kd,
            _ALL if self.stiffness is None else self.stiffness,
            self.error_max,
            J,
            robot.v,
            frame.drift,
            self.separate,
            b,
        )
        if self.motion is not None and self.separate:
            b += self._separate_feedforward(pose, self.motion)
        elif self.motion is not None:
            b += self._feedforward(between, J @ robot.v, self.motion)
        return TaskTerm(J, b, self.weight)

    def _separate_feedforward(self, pose: pin.SE3, motion: PoseMotion) -> Array:
        """Return ``kd (p_d', w_d) + (p_d'', w_d')`` in the end effector's axes, shape (6,)."""
        speed, turn = np.split(motion.twist, 2)
        rate = motion.twist_rate.copy()
        rate[:3] += np.cross(turn, speed)  # the goal's axes turn
        ahead = (self.kd * motion.twist + rate).reshape(2, 3)
        turned: Array = (ahead @ self.pose_des.rotation.T @ pose.rotation).ravel()
        return turned

    def _feedforward(self, between: pin.SE3, twist: Array, motion: PoseMotion) -> Array:
        """Return what a goal in motion adds, shape (6,), in the end effector's axes.

        The goal's twist as seen at the end effector is X xi_des with X the action of the placement
        H^-1 H_des between them; it changes with rate ``X xi_des' - xi x (X xi_des)``, because the
        axes move with the twist xi of the end effector.
        """
        seen = between.act(pin.Motion(motion.twist))
        rate = between.act(pin.Motion(motion.twist_rate)) - pin.Motion(twist).cross(seen)
        feedforward: Array = self.kd * seen.vector + rate.vector
        return feedforward


@njit(cache=True)
def _spring_and_damper(
    error: Array,
    kp: float,
    kd: float,
    stiffness: Array,
    error_max: tuple[float, float],
    J: Array,
    v: Array,
    drift: Array,
    separate: bool,
    b: Array,
) -> None:
    """Write ``kp error - kd J v - J' v`` to b, shape (6,), see `PoseTask`.

    The error is given as it is, or, with `separate`, as translation and quaternion, shape (7,).
    """
    if separate:
        error = _with_rotation_vector(error)
    twist = np.zeros(6)
    for i in range(6):
        for j in range(v.size):
            twist[i] += J[i, j] * v[j]
    for first in (0, 3):
        x, y, z = error[first], error[first + 1], error[first + 2]
        size, largest = math.sqrt(x * x + y * y + z * z), error_max[first // 3]
        share = largest / size if size > largest else 1.0
        for i in range(first, first + 3):
            b[i] = kp * stiffness[i] * share * error[i] - kd * twist[i] - drift[i]
    if separate:
        # The rows of J a + J' v are in axes that turn with w: the origin has w x v more.
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            b[i] -= twist[3 + j] * twist[k] - twist[3 + k] * twist[j]


@njit(cache=True)
def _with_rotation_vector(place: Array) -> Array:
    """Return translation and log(R), shape (6,), of a translation and a quaternion of R."""
    error, w = place[:6].copy(), place[6]
    sine = math.sqrt(place[3] ** 2 + place[4] ** 2 + place[5] ** 2)
    # Of the two angles the one of at most half a turn; w is 1 where it is tiny.
    angle = 2.0 * math.atan2(sine, abs(w))
    error[3:] *= math.copysign(angle / sine if sine > 0.0 else 2.0, w)
    return error


def shorten(vector: Array, largest: float) -> None:
    """Shorten a vector of 3 numbers, in place, to a length of at most `largest`."""
    length = math.hypot(*vector.tolist())
    if length > largest:
        vector *= largest / length


def pose_error(pose: pin.SE3, pose_des: pin.SE3) -> Array:
    """Return ``log(H^-1 H_des)``, shape (6,): m, then rad, in the end effector's axes."""
    error: Array = pin.log6(pose.actInv(pose_des)).vector
    return error
