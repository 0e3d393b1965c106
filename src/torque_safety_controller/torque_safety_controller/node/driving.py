# SPDX-License-Identifier: Apache-2.0
"""Jogs and trajectories of the joints from messages."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pinocchio as pin
from geometry_msgs.msg import TwistStamped
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import Header
from trajectory_msgs.msg import JointTrajectory as JointTrajectoryMessage

from torque_safety_controller.controller import Controller
from torque_safety_controller.driving.jog import HAND_SPEED_MAX, TIMEOUT, HandJog, JointJog
from torque_safety_controller.driving.trajectory import (
    JointMotion,
    JointPoint,
    JointTrajectory,
    JointTrajectoryError,
)
from torque_safety_controller.node.goals import GoalRefused, GoalSubscriber, vector_of
from torque_safety_controller.node.periodic import StateStream
from torque_safety_controller.node.topics import JOG_HAND, JOG_JOINTS, TARGET_JOINT_TRAJECTORY
from torque_safety_controller.parameters.controller_parameters import ControllerConfiguration
from viability_bounds_pkg.exceptions import did_you_mean
from viability_bounds_pkg.ros.runtime import stamp_to_ns


def twist_from_message(message: TwistStamped) -> np.ndarray:
    """Return linear and angular velocity, shape (6,), m/s and rad/s.

    Raises:
        GoalRefused: a number that is not finite.
    """
    twist = np.concatenate([vector_of(message.twist.linear), vector_of(message.twist.angular)])
    if not np.isfinite(twist).all():
        raise GoalRefused("twist is not finite")
    return twist


def velocities_from_message(message: JointState, joints: Sequence[str]) -> np.ndarray:
    """Return the velocities of all joints, 0 for those not named, shape (n,), rad/s.

    Raises:
        GoalRefused: an unknown joint or none, positions, or a number that is not finite.
    """
    if len(message.name) != len(message.velocity) or not message.name:
        raise GoalRefused(f"{len(message.name)} names but {len(message.velocity)} velocities")
    if len(message.position):
        raise GoalRefused("position is given; allowed: velocity only")
    _check_names(message.name, joints)
    where = dict(zip(message.name, message.velocity, strict=True))
    velocities = np.array([where.get(joint, 0.0) for joint in joints])
    if not np.isfinite(velocities).all():
        raise GoalRefused("velocity is not finite")
    return velocities


def joint_trajectory_from_message(
    message: JointTrajectoryMessage,
    joints: Sequence[str],
    q_min: np.ndarray,
    q_max: np.ndarray,
) -> JointTrajectory:
    """Return the trajectory that a message asks of the joints, matched by name.

    Args:
        message: with at least one point.
        joints: names of the n joints.
        q_min: lower position limits, shape (n,), rad.
        q_max: upper ones, shape (n,), rad.

    Raises:
        GoalRefused: names, sizes or numbers that cannot be followed, a position out of its limits.
    """
    names = list(message.joint_names)
    _check_names(names, joints)
    if missing := [joint for joint in joints if joint not in names]:
        raise GoalRefused(f"no positions for {', '.join(missing)}")
    order = [names.index(joint) for joint in joints]
    points = []
    for k, point in enumerate(message.points):
        if len(point.effort):
            raise GoalRefused(f"points[{k}] has efforts; allowed: none")
        parts: list[np.ndarray | None] = []
        for what in ("positions", "velocities", "accelerations"):
            given = getattr(point, what)
            if len(given) not in ((len(names),) if what == "positions" else (0, len(names))):
                raise GoalRefused(f"points[{k}] has {len(given)} {what} of {len(names)} joints")
            parts.append(np.array(given)[order] if len(given) else None)
        q = parts[0]
        assert q is not None
        for joint, value, low, high in zip(joints, q, q_min, q_max, strict=True):
            if not low <= value <= high:
                raise GoalRefused(
                    f"points[{k}]: {joint} is {value:g} rad; allowed: {low:g} to {high:g}"
                )
        time = point.time_from_start.sec + 1e-9 * point.time_from_start.nanosec
        points.append(JointPoint(time, q, *parts[1:]))
    try:
        return JointTrajectory(points)
    except JointTrajectoryError as error:
        raise GoalRefused(str(error)) from error


def _check_names(names: Sequence[str], joints: Sequence[str]) -> None:
    for name in names:
        if name not in joints:
            raise GoalRefused(f"unknown joint '{name}'{did_you_mean(name, joints)}")
    if len(set(names)) != len(names):
        raise GoalRefused("a joint is named twice")


class Driving:
    """Subscribes to ``jog_hand``, ``jog_joints`` and ``target_joint_trajectory``.

    What came last counts, also before poses and postures that came earlier. A stamp of zero means
    now. Jogs with a stamp that differs from that of the newest joint state by more than `TIMEOUT`
    are refused: they are late, or of another clock.

    Args:
        node: logs.
        goals: listens, and keeps what is not due yet.
        controller: is driven.
        config: has the names and limits.
        base: placement of the base frame in the URDF's root frame.
        states: tell the robot's time.
    """

    def __init__(
        self,
        node: Node,
        goals: GoalSubscriber,
        controller: Controller,
        config: ControllerConfiguration,
        base: pin.SE3,
        states: StateStream,
    ) -> None:
        self._node, self._goals, self._controller = node, goals, controller
        self._config, self._base, self._states = config, base, states
        goals.listen(JOG_HAND, self._on_hand)
        goals.listen(JOG_JOINTS, self._on_joints)
        goals.listen(TARGET_JOINT_TRAJECTORY, self._on_trajectory)

    def _check_stamp(self, header: Header) -> None:
        stamp, now = stamp_to_ns(header.stamp), self._states.stamp
        apart = 1e-9 * (stamp - now)
        if stamp and now >= 0 and abs(apart) > TIMEOUT:
            when = "ahead of" if apart > 0 else "before"
            raise GoalRefused(
                f"header.stamp is {abs(apart):.3g} s {when} that of the joint states; allowed: "
                f"{TIMEOUT:g} s, or 0"
            )

    def _on_hand(self, message: TwistStamped) -> None:
        hand, frame = self._config.end_effectors[0], message.header.frame_id
        if frame not in ("", self._config.base_frame, hand):
            raise GoalRefused(
                f"frame_id is '{frame}'; allowed: '{hand}', '{self._config.base_frame}' or empty"
            )
        twist = twist_from_message(message)
        self._check_stamp(message.header)
        in_hand = frame == hand
        if not in_hand:
            twist = (twist.reshape(2, 3) @ self._base.rotation.T).ravel()

        def jog() -> None:
            motion = self._goals.motion
            if not isinstance(motion, HandJog):
                motion = HandJog(self._hand_speed_max())
                self._goals.move(motion)
            motion.command_twist(twist, in_hand)

        self._goals.add(message, jog)

    def _hand_speed_max(self) -> tuple[float, float]:
        largest = self._controller.goals.gains.pose_speed_max
        if not len(largest):
            return HAND_SPEED_MAX
        return float(largest[0]), float(largest[1])

    def _on_joints(self, message: JointState) -> None:
        velocities = velocities_from_message(message, self._config.joints)
        self._check_stamp(message.header)
        self._goals.add(message, lambda: self._jog_joints(velocities))

    def _jog_joints(self, velocities: np.ndarray) -> None:
        config, motion = self._config, self._goals.motion
        if not isinstance(motion, JointJog):
            motion = JointJog(config.position_min, config.position_max, config.velocity_max)
            self._goals.move(motion)
        motion.command(velocities)

    def _on_trajectory(self, message: JointTrajectoryMessage) -> None:
        config = self._config
        if not message.points:  # as controllers of trajectories take it: stop
            self._goals.add(message, lambda: self._jog_joints(np.zeros(len(config.joints))))
            return
        trajectory = joint_trajectory_from_message(
            message, config.joints, config.position_min, config.position_max
        )
        begin = stamp_to_ns(message.header.stamp)
        fastest = trajectory.fastest() / config.velocity_max
        if (worst := int(fastest.argmax())) >= 0 and fastest[worst] > 1.0:
            self._node.get_logger().warning(
                f"target_joint_trajectory: {config.joints[worst]} is asked for "
                f"{fastest[worst]:.3g} times its velocity_max: the arm falls behind"
            )
        motion = JointMotion(
            trajectory, begin, config.position_min, config.position_max, config.velocity_max
        )
        self._goals.add(message, lambda: self._goals.move(motion))
