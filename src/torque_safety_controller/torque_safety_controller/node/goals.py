# SPDX-License-Identifier: Apache-2.0
"""Goals from topics, given to the controller when they are due."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pinocchio as pin
from geometry_msgs.msg import PoseStamped, TwistStamped
from numpy.typing import NDArray
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory, MultiDOFJointTrajectory

from torque_safety_controller.controller import Controller
from torque_safety_controller.driving.jog import HAND_SPEED_MAX, TIMEOUT, HandJog, JointJog
from torque_safety_controller.driving.trajectory import (
    JointMotion,
    Motion,
    TrajectoryMotion,
)
from torque_safety_controller.node.goal_messages import (
    GoalRefused,
    check_frame,
    check_stamp,
    joint_trajectory_from_message,
    pose_from_message,
    posture_from_message,
    trajectory_from_message,
    velocities_from_message,
)
from torque_safety_controller.node.periodic import StateStream
from torque_safety_controller.node.topics import (
    JOG_HAND,
    JOG_JOINTS,
    TARGET_JOINT_TRAJECTORY,
    TARGET_POSE,
    TARGET_POSE_SECOND,
    TARGET_POSTURE,
    TARGET_TRAJECTORY,
)
from torque_safety_controller.node.waiting_goals import WaitingGoals
from torque_safety_controller.parameters.controller_parameters import ControllerConfiguration
from viability_bounds_pkg.ros.arm_node import ArmNode
from viability_bounds_pkg.ros.messages import numbers_of
from viability_bounds_pkg.ros.runtime import stamp_to_ns
from viability_bounds_pkg.ros.topics import Topic
from viability_bounds_pkg.state import State, whole_turns

Array = NDArray[np.float64]

_ROUNDING = 1e-9

NEEDED = {
    TARGET_POSE.name: ("pose_weight", "pose_kp"),
    TARGET_POSE_SECOND.name: ("pose_weight", "pose_kp"),
    TARGET_TRAJECTORY.name: ("pose_weight", "pose_kp"),
    TARGET_POSTURE.name: ("posture_kp",),
    TARGET_JOINT_TRAJECTORY.name: ("posture_kp",),
}
"""Gains that are not to be 0 where goals of a topic are to be reached."""


class GoalSubscriber:
    """Subscribes to the topics of goals, ``target_*`` and ``jog_*``; what came last counts.

    Jogs with a stamp that differs from that of the newest joint state by more than `TIMEOUT`, then
    or when they are due, are refused, and trajectories that have passed. Where several nodes
    publish one of these topics, the arm is to hold until there is one.

    Args:
        node: listens, and logs.
        controller: is given the goals when they are due.
        config: has the names and limits that they are checked by.
        base: placement of the base frame in the URDF's root frame.
        states: tell the robot's time.

    Attributes:
        waiting: goals that are not due yet.
    """

    def __init__(
        self,
        node: ArmNode,
        controller: Controller,
        config: ControllerConfiguration,
        base: pin.SE3,
        states: StateStream,
    ) -> None:
        self._node, self.waiting = node, WaitingGoals(node, states, config.goal_ahead_max)
        self._controller, self._config, self._base = controller, config, base
        self._states, self._held = states, controller.goals.held
        self._motion: Motion | None = None
        self._unserved: set[str] = set()
        self._held_up: Motion | None = None
        listen = self.waiting.listen
        listen(TARGET_POSE, self._on_pose)
        if len(config.end_effectors) > 1:
            listen(TARGET_POSE_SECOND, self._on_second_pose)
        listen(TARGET_POSTURE, self._on_posture)
        listen(TARGET_TRAJECTORY, self._on_trajectory)
        listen(TARGET_JOINT_TRAJECTORY, self._on_joint_trajectory)
        listen(JOG_HAND, self._on_hand_jog)
        listen(JOG_JOINTS, self._on_joint_jog)

    @property
    def motion(self) -> Motion | None:
        """What sets the goal in each control step; None for goals at rest."""
        return self._motion

    @motion.setter
    def motion(self, motion: Motion | None) -> None:
        self._motion = motion
        self._controller.goals.come_to_rest()  # where the one before leaves them

    @property
    def due(self) -> str:
        """Which goal waits, for the arm or for its time, in words; empty if there is none."""
        motion = self.motion
        if isinstance(motion, (JointMotion, TrajectoryMotion)) and motion.pace.waits:
            return f"{_topic_of(motion)} waits for the arm"
        return self.waiting.due

    @property
    def trouble(self) -> str:
        """Cause not to serve goals, a key of `modes.CAUSES`; empty for none."""
        if self.waiting.contested:
            return "rival"
        return "" if self._controller.goals.any else "no goal"

    def apply_due(self, stamp: int, state: State) -> bool:
        """Apply the goals that are due at `stamp`, ns, and advance a motion.

        A motion ends where the arm has made the pose where it is its goal.

        Args:
            stamp: of the state, ns.
            state: of the joints.

        Returns:
            Whether any were due, or a motion continues.
        """
        if self._held != self._controller.goals.held:
            self._held, self.motion = self._controller.goals.held, None
        due = self.waiting.apply_due(stamp)
        for topic in due:
            self._warn_unserved(topic)
        if self.motion is None:
            return bool(due)
        if not self.motion.advance(self._controller, state, stamp):
            self.motion = None
        elif isinstance(self.motion, (JointMotion, TrajectoryMotion)):
            self._watch_pace(self.motion)
        return True

    def _watch_pace(self, motion: JointMotion | TrajectoryMotion) -> None:
        """Tell once that a trajectory waits for the arm; give it up where they are far apart."""
        if motion.pace.lost:
            what = "given up"
            self._jog_joints(np.zeros(len(self._config.joints)))  # to rest
            self.waiting.refused[_topic_of(motion)] += 1
        elif motion.pace.waits and self._held_up is not motion:
            self._held_up, what = motion, "waits for the arm"
        else:
            return
        where = motion.where(self._config.joints)
        self._node.get_logger().warning(f"{_topic_of(motion)} {what}: {where}")

    def _warn_unserved(self, topic: str) -> None:
        """Warn of the first of the goals that no task brings the arm to."""
        gains = self._controller.goals.gains
        off = [name for name in NEEDED.get(topic, ()) if not getattr(gains, name)]
        if off and topic not in self._unserved:
            self._node.get_logger().warning(
                f"{topic}: {off[0]} is 0: no task brings the arm to the goal"
            )
        (self._unserved.add if off else self._unserved.discard)(topic)

    def _move(self, motion: JointMotion | TrajectoryMotion) -> None:
        states = self._states
        motion.check_late(self._controller, State(states.q, states.v), states.stamp)
        self.motion = motion

    def base_moved(self, motion: pin.SE3) -> None:
        """Leave poses where they are in the base frame, which has moved in the root frame."""
        if not motion.isIdentity(_ROUNDING):
            if isinstance(self.motion, TrajectoryMotion):
                self.motion = None
                self.waiting.refuse(TARGET_TRAJECTORY, "base_frame has moved")
            self._controller.goals.move_poses(motion)

    # Goals at rest

    def _on_pose(self, message: PoseStamped) -> None:
        pose = self._base * pose_from_message(message, self._config.base_frame)

        def apply() -> None:
            self.motion = None
            self._controller.goals.set_pose(pose)

        self.waiting.add(TARGET_POSE, message, apply)

    def _on_second_pose(self, message: PoseStamped) -> None:
        pose = self._base * pose_from_message(message, self._config.base_frame)

        def apply() -> None:
            if isinstance(self.motion, JointMotion | JointJog):  # which release the hands
                self.motion = None
            self._controller.goals.set_other_pose(0, pose)

        self.waiting.add(TARGET_POSE_SECOND, message, apply)

    def _on_posture(self, message: JointState) -> None:
        q_des = posture_from_message(message, self._config)

        def apply() -> None:
            if not isinstance(self.motion, TrajectoryMotion):  # which leaves the posture to others
                self.motion = None
            turns = whole_turns(q_des, self._states.q, self._config.continuous)
            self._controller.goals.set_posture(q_des + turns)

        self.waiting.add(TARGET_POSTURE, message, apply)

    # Goals that move

    def _on_trajectory(self, message: MultiDOFJointTrajectory) -> None:
        frames = self._config.base_frame, self._config.end_effectors[0]
        trajectory = trajectory_from_message(message, *frames, self._base)
        begin = stamp_to_ns(message.header.stamp)
        motion = TrajectoryMotion(trajectory, begin, self._config.dt)
        self.waiting.add(TARGET_TRAJECTORY, message, lambda: self._move(motion))

    def _on_joint_trajectory(self, message: JointTrajectory) -> None:
        config, topic = self._config, TARGET_JOINT_TRAJECTORY
        if not message.points:  # as controllers of trajectories take it: stop
            self.waiting.add(
                topic, message, lambda: self._jog_joints(np.zeros(len(config.joints)))
            )
            return
        trajectory = joint_trajectory_from_message(message, config)
        excess = trajectory.fastest() / config.velocity_max
        if excess[worst := int(excess.argmax())] > 1.0:
            self._node.get_logger().warning(
                f"target_joint_trajectory: {config.joints[worst]} is asked for "
                f"{excess[worst]:.3g} times its velocity_max: it takes longer"
            )
        limits = config.position_min, config.position_max, config.velocity_max
        begin = stamp_to_ns(message.header.stamp)
        motion = JointMotion(trajectory, begin, config.dt, *limits, config.continuous)
        self.waiting.add(topic, message, lambda: self._move(motion))

    def _on_hand_jog(self, message: TwistStamped) -> None:
        hand, frame = self._config.end_effectors[0], message.header.frame_id
        check_frame(frame, hand, self._config.base_frame)
        twist = numbers_of(message.twist.linear, message.twist.angular)
        if not np.isfinite(twist).all():
            raise GoalRefused("twist is not finite")
        in_hand = frame == hand
        if not in_hand:
            twist = (twist.reshape(2, 3) @ self._base.rotation.T).ravel()

        def jog() -> None:
            motion = self.motion
            if not isinstance(motion, HandJog):
                largest = self._controller.goals.gains.pose_speed_max
                motion = HandJog(largest.tolist() or HAND_SPEED_MAX)
                self.motion = motion
            motion.command_twist(twist, in_hand)

        self._add_jog(JOG_HAND, message, jog)

    def _on_joint_jog(self, message: JointState) -> None:
        velocities = velocities_from_message(message, self._config.joints)
        self._add_jog(JOG_JOINTS, message, lambda: self._jog_joints(velocities))

    def _jog_joints(self, velocities: Array) -> None:
        config, motion = self._config, self.motion
        if not isinstance(motion, JointJog):
            motion = JointJog(config.position_min, config.position_max, config.velocity_max)
            self.motion = motion
        motion.command(velocities)

    def _add_jog(
        self, topic: Topic, message: TwistStamped | JointState, jog: Callable[[], None]
    ) -> None:
        """Call `jog` when it is due, unless the robot was silent until it was too old."""
        stamp, states, most = stamp_to_ns(message.header.stamp), self._states, TIMEOUT
        check_stamp(stamp, states.stamp, most, most)
        came, most = stamp or states.stamp, most + self._config.dt

        def apply() -> None:
            if abs(states.stamp - came) > 1e9 * most:
                raise GoalRefused(f"no joint state has come within {TIMEOUT:g} s of it")
            jog()

        self.waiting.add(topic, message, apply)


def _topic_of(motion: JointMotion | TrajectoryMotion) -> str:
    of_joints = isinstance(motion, JointMotion)
    return (TARGET_JOINT_TRAJECTORY if of_joints else TARGET_TRAJECTORY).name
