"""Tasks: what the accelerations should do, as weighted least squares.

Each task asks for ``A a = b`` with a weight, eq. (5) and (9) of [Benallegue2021]; `A` is None
where it is the identity, which spares the product.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from torque_safety_controller.linalg.dense_kernels import (
    null_space_part,
    spring_damper,
    spring_damper_rows,
)
from torque_safety_controller.robot_model import RobotModel

_RANK_REGULARISATION = 1e-9


class TaskTerm(NamedTuple):
    """The term ``weight * |A a - b|^2`` of the QP's cost."""

    A: np.ndarray | None
    """Shape (m, n), or None for the identity."""
    b: np.ndarray
    """Shape (m,)."""
    weight: float


class WrenchTerm(NamedTuple):
    """The term ``weight * |W rho - F_des|^2`` of the QP's cost: [Benallegue2021], III-E (a)."""

    W: np.ndarray
    """Shape (m, r): what rho >= 0 means as a wrench, or as some components of it."""
    F_des: np.ndarray
    """Shape (m,), N and N m: what the environment should exert on the link."""
    weight: float
    first: int
    """Where the r coefficients begin among those of all contacts."""


def critical_damping(kp: float) -> float:
    """Return ``2 sqrt(kp)``, the gain that brings an error to zero fastest without overshoot."""
    return 2.0 * math.sqrt(kp)


def posture_task(
    q_des: np.ndarray,
    q: np.ndarray,
    v: np.ndarray,
    kp: float,
    kd: float,
    weight: float,
    J: np.ndarray | None = None,
    ahead: np.ndarray | None = None,
) -> TaskTerm:
    """Bring the joints to `q_des`: eq. (34) of [DelPrete2018], eq. (6) of [Benallegue2021].

    As the paper has it, posture and pose pull against each other with their weights, and the
    pose rests off its goal by about the ratio of the weights in m per rad. With `J` the
    posture pulls only where the pose does not feel it, so that the pose is reached; damping
    acts everywhere either way.

    Args:
        q_des: desired positions, shape (n,), rad.
        q: positions, shape (n,), rad.
        v: velocities, shape (n,), rad/s.
        kp: stiffness, 1/s^2.
        kd: damping, 1/s.
        weight: of the squared error of acceleration.
        J: Jacobian of the task not to be disturbed, shape (m, n), or None.
        ahead: feed-forward, ``kd v_des + a_des``, shape (n,), rad/s^2; None for a goal at rest.
    """
    error = q_des - q
    if J is not None:
        # Regularised where J has lost rank; there it leaves in what the task cannot move anyway.
        error = null_space_part(J, error, _RANK_REGULARISATION)
    b = spring_damper(error, v, kp, kd)
    return TaskTerm(None, b if ahead is None else b + ahead, weight)


def damping_task(v: np.ndarray, kd: float) -> TaskTerm:
    """Bring the joints to rest wherever they are."""
    return TaskTerm(None, -kd * v, 1.0)


def pose_error(pose: pin.SE3, pose_des: pin.SE3) -> np.ndarray:
    """Return ``log(H^-1 H_des)``, shape (6,): m, then rad, in the end effector's axes."""
    return pin.log6(pose.actInv(pose_des)).vector


def pose_feed_forward(
    robot: RobotModel,
    v: np.ndarray,
    pose_des: pin.SE3,
    twist: np.ndarray,
    twist_rate: np.ndarray,
    kd: float,
) -> np.ndarray:
    """Return what a goal in motion adds to `pose_task`, shape (6,), in the end effector's axes.

    The goal's twist as seen at the end effector is X xi_des with X the action of the placement
    H^-1 H_des between them; it changes with rate ``X xi_des' - xi x (X xi_des)``, because the axes
    move with the twist xi of the end effector.

    Args:
        robot: updated to the current state.
        v: joint velocities, shape (n,), rad/s.
        pose_des: goal.
        twist: its twist xi_des in its own axes, shape (6,), m/s and rad/s.
        twist_rate: time derivative of `twist`, shape (6,).
        kd: damping of the pose task, 1/s.
    """
    between = robot.pose.actInv(pose_des)
    ahead = between.act(pin.Motion(twist))
    own = pin.Motion(robot.J @ v)
    rate = between.act(pin.Motion(twist_rate)) - own.cross(ahead)
    return kd * ahead.vector + rate.vector


def pose_task(
    robot: RobotModel,
    v: np.ndarray,
    error: np.ndarray,
    kp: float,
    kd: float,
    weight: float,
    ahead: np.ndarray | None = None,
) -> TaskTerm:
    """Bring the end effector to a pose: eq. (34) of [DelPrete2018], (7)-(8) of [Benallegue2021].

    Args:
        robot: updated to the current state.
        v: joint velocities, shape (n,), rad/s.
        error: `pose_error`, shape (6,).
        kp: stiffness, 1/s^2.
        kd: damping, 1/s.
        weight: of the squared error of acceleration.
        ahead: `pose_feed_forward`, or None for a goal at rest.
    """
    b = spring_damper_rows(robot.J, v, error, robot.drift, kp, kd)
    return TaskTerm(robot.J, b if ahead is None else b + ahead, weight)
