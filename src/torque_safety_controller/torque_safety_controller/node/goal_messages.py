# SPDX-License-Identifier: Apache-2.0
"""Goals out of messages: names, frames and numbers checked, arrays and trajectories made."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pinocchio as pin
from geometry_msgs.msg import Point, PoseStamped, Quaternion, Vector3
from numpy.typing import NDArray
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory as JointTrajectoryMessage
from trajectory_msgs.msg import MultiDOFJointTrajectory

from torque_safety_controller.driving.trajectory import (
    JointPoint,
    JointTrajectory,
    JointTrajectoryError,
)
from viability_bounds_pkg.exceptions import ArmSafetyError, did_you_mean
from viability_bounds_pkg.plausible import FARTHEST
from viability_bounds_pkg.pose_trajectory import (
    PoseTrajectory,
    TrajectoryError,
    TrajectoryPoint,
)
from viability_bounds_pkg.robot.configuration import RobotConfiguration
from viability_bounds_pkg.ros.messages import numbers_of
from viability_bounds_pkg.ros.refusals import stamp_fault
from viability_bounds_pkg.ros.runtime import stamp_to_ns

Array = NDArray[np.float64]

_QUATERNION_TOLERANCE = 1e-3
_FARTHEST = 100.0  # m; no arm is longer
_FASTEST = 1e6  # m/s, rad/s, m/s^2 or rad/s^2; nothing is faster


class GoalRefused(ArmSafetyError, ValueError):
    """A goal message that cannot be followed."""


def check_frame(frame: str, *allowed: str) -> None:
    """Refuse a message in another frame than those allowed; an empty name stands for the base."""
    if frame and frame not in allowed:
        names = ", ".join(f"'{name}'" for name in allowed)
        raise GoalRefused(f"frame_id is '{frame}'; allowed: {names} or empty")


def check_stamp(stamp: int, now: int, ahead_max: float, late_max: float = math.inf) -> None:
    """Refuse a stamp that is far from the robot's time; see `stamp_fault`."""
    if fault := stamp_fault(stamp, now, ahead_max, late_max):
        raise GoalRefused(fault)


def pose_from_message(message: PoseStamped, base_frame: str) -> pin.SE3:
    """Return the placement that a message asks for, in the base frame.

    Raises:
        GoalRefused: another frame, a number that is not finite, a quaternion that is not unit.
    """
    check_frame(message.header.frame_id, base_frame)
    return _placement(message.pose.position, message.pose.orientation)


def _placement(p: Point | Vector3, o: Quaternion) -> pin.SE3:
    place, quaternion = numbers_of(p), np.array([o.x, o.y, o.z, o.w])
    if not (np.isfinite(place).all() and np.isfinite(quaternion).all()):
        raise GoalRefused("pose is not finite")
    if (far := np.abs(place).max()) > _FARTHEST:
        raise GoalRefused(f"position is {far:g} m away; allowed: up to {_FARTHEST:g} m")
    norm = math.hypot(*quaternion.tolist())
    if abs(norm - 1.0) > _QUATERNION_TOLERANCE:
        raise GoalRefused(f"orientation has norm {norm:.4g}; allowed: 1 within 0.001")
    return pin.SE3(pin.Quaternion(quaternion / norm).toRotationMatrix(), place)


def trajectory_from_message(
    message: MultiDOFJointTrajectory, base_frame: str, end_effector_frame: str, base: pin.SE3
) -> PoseTrajectory:
    """Return the trajectory that a message asks of the end effector.

    Args:
        message: each point has one transform, and one velocity and one acceleration or none,
            which are then zero; all in the base frame.
        base_frame: what the message's ``frame_id`` may be, if it is not empty.
        end_effector_frame: what its only joint name may be, if there is one.
        base: placement of the base frame in the URDF's root frame, in which the result is.

    Raises:
        GoalRefused: frames, sizes or numbers that cannot be followed.
    """
    check_frame(message.header.frame_id, base_frame)
    if list(message.joint_names) not in ([], [end_effector_frame]):
        raise GoalRefused(
            f"joint_names is {list(message.joint_names)}; allowed: '{end_effector_frame}' or none"
        )
    points = []
    for k, point in enumerate(message.points):
        sizes = len(point.transforms), len(point.velocities), len(point.accelerations)
        if sizes[0] != 1 or max(sizes) > 1:
            raise GoalRefused(f"points[{k}] must have one transform, velocity and acceleration")
        rates = np.zeros((2, 6))
        for rate, given in zip(rates, (point.velocities, point.accelerations), strict=True):
            for twist in given:
                parts = numbers_of(twist.linear, twist.angular).reshape(2, 3)
                rate[:] = (parts @ base.rotation.T).ravel()
        if (fast := np.abs(rates).max()) > _FASTEST:
            raise GoalRefused(f"points[{k}] asks for {fast:g}; allowed: up to {_FASTEST:g}")
        transform = point.transforms[0]
        pose = base * _placement(transform.translation, transform.rotation)
        time = 1e-9 * stamp_to_ns(point.time_from_start)
        points.append(TrajectoryPoint(time, pose, *rates))
    try:
        return PoseTrajectory(points)
    except TrajectoryError as error:
        raise GoalRefused(str(error)) from error


def posture_from_message(message: JointState, config: RobotConfiguration) -> Array:
    """Return the positions that a message asks for, shape (n,), rad, matched by name.

    Raises:
        GoalRefused: a joint is missing, a number is not finite or outside the limits.
    """
    if len(message.name) != len(message.position):
        raise GoalRefused(f"{len(message.name)} names but {len(message.position)} positions")
    _check_once(message.name)
    where = dict(zip(message.name, message.position, strict=True))
    _check_complete(list(where), config.joints)
    q = np.array([where[joint] for joint in config.joints])
    _check_positions(q, config)
    return q


def velocities_from_message(message: JointState, joints: Sequence[str]) -> Array:
    """Return the velocities of all joints, 0 for those not named, shape (n,), rad/s.

    Raises:
        GoalRefused: an unknown joint or none, positions, or a number that is not finite.
    """
    if len(message.name) != len(message.velocity) or not message.name:
        raise GoalRefused(f"{len(message.name)} names but {len(message.velocity)} velocities")
    if len(message.position):
        raise GoalRefused("position is given; allowed: velocity only")
    _check_known(message.name, joints)
    where = dict(zip(message.name, message.velocity, strict=True))
    velocities = np.array([where.get(joint, 0.0) for joint in joints])
    if not np.isfinite(velocities).all():
        raise GoalRefused("velocity is not finite")
    return velocities


def joint_trajectory_from_message(
    message: JointTrajectoryMessage, config: RobotConfiguration
) -> JointTrajectory:
    """Return the trajectory that a message asks of the joints, matched by name.

    Args:
        message: with at least one point.
        config: names of the joints, and their position limits.

    Raises:
        GoalRefused: names, sizes or numbers that cannot be followed, a position out of its limits.
    """
    names = list(message.joint_names)
    _check_known(names, config.joints)
    _check_complete(names, config.joints)
    order = [names.index(joint) for joint in config.joints]
    points = []
    for k, point in enumerate(message.points):
        if len(point.effort):
            raise GoalRefused(f"points[{k}] has efforts; allowed: none")
        parts: list[Array | None] = []
        for what in ("positions", "velocities", "accelerations"):
            given = getattr(point, what)
            if len(given) != len(names) and (len(given) or what == "positions"):
                raise GoalRefused(f"points[{k}] has {len(given)} {what} of {len(names)} joints")
            parts.append(np.array(given)[order] if len(given) else None)
        q, v, a = parts
        assert q is not None
        _check_positions(q, config, f"points[{k}]: ")
        time = 1e-9 * stamp_to_ns(point.time_from_start)
        points.append(JointPoint(time, q, v, a))
    try:
        return JointTrajectory(points)
    except JointTrajectoryError as error:
        raise GoalRefused(str(error)) from error


def _check_known(names: Sequence[str], joints: Sequence[str]) -> None:
    for name in names:
        if name not in joints:
            raise GoalRefused(f"unknown joint '{name}'{did_you_mean(name, joints)}")
    _check_once(names)


def _check_once(names: Sequence[str]) -> None:
    if len(set(names)) != len(names):
        raise GoalRefused("a joint is named twice")


def _check_complete(names: Sequence[str], joints: Sequence[str]) -> None:
    if missing := [joint for joint in joints if joint not in names]:
        raise GoalRefused(f"no position for {', '.join(missing)}")


def _check_positions(q: Array, config: RobotConfiguration, where: str = "") -> None:
    limits = np.clip((config.position_min, config.position_max), -FARTHEST, FARTHEST)
    for joint, value, low, high in zip(config.joints, q, *limits, strict=True):
        if not low <= value <= high:
            raise GoalRefused(f"{where}{joint} is {value:g} rad; allowed: {low:g} to {high:g}")
