# SPDX-License-Identifier: Apache-2.0
"""Goals from messages: checked, and kept until the time of their stamps."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
import pinocchio as pin
from geometry_msgs.msg import Point, PoseStamped, Quaternion, Vector3
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import MultiDOFJointTrajectory

from torque_safety_controller.controller import Controller
from torque_safety_controller.driving.trajectory import Motion, TrajectoryMotion
from torque_safety_controller.node.topics import (
    TARGET_POSE,
    TARGET_POSE_SECOND,
    TARGET_POSTURE,
    TARGET_TRAJECTORY,
)
from torque_safety_controller.parameters.controller_parameters import ControllerConfiguration
from viability_bounds_pkg.exceptions import ArmSafetyError
from viability_bounds_pkg.pose_trajectory import (
    PoseTrajectory,
    TrajectoryError,
    TrajectoryPoint,
)
from viability_bounds_pkg.ros.arm_node import ArmNode
from viability_bounds_pkg.ros.runtime import stamp_to_ns
from viability_bounds_pkg.ros.topics import Topic
from viability_bounds_pkg.state import State

_QUATERNION_TOLERANCE = 1e-3
_FARTHEST = 100.0  # m; no arm is longer
_FASTEST = 1e6  # m/s, rad/s, m/s^2 or rad/s^2; nothing is faster


class GoalRefused(ArmSafetyError, ValueError):
    """A goal message that cannot be followed."""


def pose_from_message(message: PoseStamped, base_frame: str) -> pin.SE3:
    """Return the placement that a message asks for, in the base frame.

    Raises:
        GoalRefused: another frame, a number that is not finite, a quaternion that is not unit.
    """
    check_frame(message, base_frame)
    return _placement(message.pose.position, message.pose.orientation)


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
    check_frame(message, base_frame)
    if list(message.joint_names) not in ([], [end_effector_frame]):
        raise GoalRefused(
            f"joint_names is {list(message.joint_names)}; allowed: '{end_effector_frame}' or none"
        )
    R = base.rotation
    points = []
    for k, point in enumerate(message.points):
        sizes = len(point.transforms), len(point.velocities), len(point.accelerations)
        if sizes[0] != 1 or max(sizes) > 1:
            raise GoalRefused(f"points[{k}] must have one transform, velocity and acceleration")
        transform = point.transforms[0]
        rates = [np.zeros(6), np.zeros(6)]
        for rate, given in zip(rates, (point.velocities, point.accelerations), strict=True):
            for twist in given:
                rate[:3] = R @ vector_of(twist.linear)
                rate[3:] = R @ vector_of(twist.angular)
            if (fast := np.abs(rate).max()) > _FASTEST:
                raise GoalRefused(f"points[{k}] asks for {fast:g}; allowed: up to {_FASTEST:g}")
        pose = base * _placement(transform.translation, transform.rotation)
        time = point.time_from_start.sec + 1e-9 * point.time_from_start.nanosec
        points.append(TrajectoryPoint(time, pose, *rates))
    try:
        return PoseTrajectory(points)
    except TrajectoryError as error:
        raise GoalRefused(str(error)) from error


def check_frame(message: PoseStamped | MultiDOFJointTrajectory, base_frame: str) -> None:
    """Refuse a message in another frame than the base's; an empty name stands for that."""
    frame = message.header.frame_id
    if frame not in ("", base_frame):
        raise GoalRefused(f"frame_id is '{frame}'; allowed: '{base_frame}' or empty")


def vector_of(message: Vector3) -> np.ndarray:
    """Return the numbers of a message, shape (3,)."""
    return np.array([message.x, message.y, message.z])


def _placement(p: Point | Vector3, o: Quaternion) -> pin.SE3:
    values = (p.x, p.y, p.z, o.x, o.y, o.z, o.w)
    if not all(map(math.isfinite, values)):
        raise GoalRefused("pose is not finite")
    if (far := max(map(abs, (p.x, p.y, p.z)))) > _FARTHEST:
        raise GoalRefused(f"position is {far:g} m away; allowed: up to {_FARTHEST:g} m")
    norm = math.hypot(o.x, o.y, o.z, o.w)
    if abs(norm - 1.0) > _QUATERNION_TOLERANCE:
        raise GoalRefused(f"orientation has norm {norm:.4g}; allowed: 1 within 0.001")
    quaternion = pin.Quaternion(o.w / norm, o.x / norm, o.y / norm, o.z / norm)
    return pin.SE3(quaternion.toRotationMatrix(), np.array([p.x, p.y, p.z]))


def posture_from_message(
    message: JointState, joints: Sequence[str], q_min: np.ndarray, q_max: np.ndarray
) -> np.ndarray:
    """Return the positions that a message asks for, shape (n,), rad, matched by name.

    Raises:
        GoalRefused: a joint is missing, a number is not finite or outside the limits.
    """
    if len(message.name) != len(message.position):
        raise GoalRefused(f"{len(message.name)} names but {len(message.position)} positions")
    where = dict(zip(message.name, message.position, strict=True))
    missing = [joint for joint in joints if joint not in where]
    if missing:
        raise GoalRefused(f"no position for {', '.join(missing)}")
    q_des = np.array([where[joint] for joint in joints])
    for joint, value, low, high in zip(joints, q_des, q_min, q_max, strict=True):
        if not (math.isfinite(value) and low <= value <= high):
            raise GoalRefused(f"{joint} is {value:g} rad; allowed: {low:g} to {high:g}")
    return q_des


class GoalSubscriber:
    """Subscribes to ``target_pose``, ``target_posture`` and ``target_trajectory``.

    And to ``target_pose_second`` where there are two end effectors.

    Goals wait until they are due: a stamp of zero, or one that has passed, takes effect with the
    next control step; one ahead takes effect with the first state at or after it, which makes a
    plan of goals repeatable. Where several nodes publish one of these topics, what comes on it is
    refused, and the arm is to hold until there is one.

    Args:
        node: listens and logs what is refused.
        controller: is given the goals when they are due.
        config: has the names and limits that they are checked by.
        base: placement of the base frame in the URDF's root frame.

    Attributes:
        refused: how many goals, and publishers of goals, were refused, by topic.
        motion: sets the goal in each control step; None for goals at rest.
    """

    def __init__(
        self,
        node: ArmNode,
        controller: Controller,
        config: ControllerConfiguration,
        base: pin.SE3,
    ) -> None:
        self.refused: Counter[str] = Counter()
        self._pending: list[tuple[int, Callable[[], None]]] = []
        self._controller, self._config, self._base = controller, config, base
        self._node, self._watch = node, node.publisher_watch
        self._contested: set[str] = set()
        self.listen(TARGET_POSE, self._on_pose)
        if len(config.end_effectors) > 1:
            self.listen(TARGET_POSE_SECOND, self._on_second_pose)
        self.listen(TARGET_POSTURE, self._on_posture)
        self.listen(TARGET_TRAJECTORY, self._on_trajectory)
        self.motion: Motion | None = None
        self._taken = controller.goals.held

    def __len__(self) -> int:
        return len(self._pending)

    @property
    def trouble(self) -> str:
        """Cause not to serve goals, a key of `supervisor.CAUSES`; empty for none."""
        if self._contested:
            self._contested = {name for name in self._contested if not self._watch.admits(name)}
            if self._contested:
                return "rival"
        return "" if self._controller.goals.any else "no goal"

    def listen(self, topic: Topic, callback: Callable[[Any], None]) -> None:
        """Subscribe to a topic of goals; `callback` gets those of a node that is alone with it.

        It may raise `GoalRefused`.
        """
        name = self._node.resolve_topic_name(topic.name)
        self._watch.add(name)

        def receive(message: Any) -> None:
            if self._watch.admits(name):
                try:
                    callback(message)
                except GoalRefused as error:
                    self.refuse(topic, error)
                return
            if name in self._contested:  # told already; more may come at any rate
                self.refused[topic.name] += 1
                return
            self._contested.add(name)
            self.refuse(topic, f"several nodes publish '{name}'")

        topic.subscription(self._node, receive, partial(self.refuse, topic))

    def add(self, message: Any, apply: Callable[[], None]) -> None:
        """Call `apply` when the time in the header of `message` has come."""
        self._pending.append((stamp_to_ns(message.header.stamp), apply))
        self._pending.sort(key=lambda entry: entry[0])

    def apply_due(self, stamp: int, state: State) -> bool:
        """Apply the goals that are due at `stamp`, ns, and go on with a motion.

        A motion ends where the arm has taken the pose where it was for its goal.

        Args:
            stamp: of the state, ns.
            state: of the joints.

        Returns:
            Whether any were due, or a motion goes on.
        """
        if self._taken != self._controller.goals.held:
            self._taken, self.motion = self._controller.goals.held, None
        due = False
        while self._pending and self._pending[0][0] <= stamp:
            self._pending.pop(0)[1]()
            due = True
        if self.motion is None:
            return due
        if not self.motion.advance(self._controller, state, stamp):
            self.motion = None
        return True

    def _on_pose(self, message: PoseStamped) -> None:
        pose = pose_from_message(message, self._config.base_frame)
        self.add(message, lambda: self._rest_at(self._base * pose))

    def _on_second_pose(self, message: PoseStamped) -> None:
        pose = pose_from_message(message, self._config.base_frame)
        self.add(message, lambda: self._controller.goals.set_other_pose(0, self._base * pose))

    def _rest_at(self, pose: pin.SE3) -> None:
        self.motion = None
        self._controller.goals.set_pose(pose)

    def _on_trajectory(self, message: MultiDOFJointTrajectory) -> None:
        config = self._config
        trajectory = trajectory_from_message(
            message, config.base_frame, config.end_effectors[0], self._base
        )
        begin = stamp_to_ns(message.header.stamp)
        self.add(message, lambda: self.move(TrajectoryMotion(trajectory, begin)))

    def move(self, motion: Motion) -> None:
        """Let a motion set the goal from now on."""
        self.motion = motion

    def _on_posture(self, message: JointState) -> None:
        config = self._config
        q_des = posture_from_message(
            message, config.joints, config.position_min, config.position_max
        )
        self.add(message, lambda: self._set_posture(q_des))

    def _set_posture(self, q_des: np.ndarray) -> None:
        if not isinstance(self.motion, TrajectoryMotion):  # which leaves the posture to others
            self.motion = None
        self._controller.goals.set_posture(q_des)

    def refuse(self, topic: Topic, reason: GoalRefused | str) -> None:
        """Count and log a goal that cannot be followed, or a publisher that cannot be heard."""
        self.refused[topic.name] += 1
        self._node.get_logger().warning(f"{topic.name} refused: {reason}")
