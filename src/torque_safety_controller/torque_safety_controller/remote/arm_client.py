# SPDX-License-Identifier: Apache-2.0
"""An arm under this controller, from a Python program: move, wait, push, read, record."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from os import PathLike
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import WrenchStamped
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from torque_safety_controller.node.topics import HAND_POSE, TARGET_JOINT_TRAJECTORY, TARGET_POSE
from viability_bounds_pkg.exceptions import ArmSafetyError, did_you_mean
from viability_bounds_pkg.ros.messages import (
    Arrival,
    JointStateReader,
    numbers_of,
    pose_message,
    wrench_message,
)
from viability_bounds_pkg.ros.runtime import GOAL_QOS, is_subscribed, make_executor, set_stamp
from viability_bounds_pkg.ros.topics import DIAGNOSTICS, JOINT_STATES, LIMIT_DISTANCES, Topic
from viability_bounds_pkg.state import whole_turns

Array = NDArray[np.float64]

_RECORDING_QOS = QoSProfile(depth=5000, reliability=ReliabilityPolicy.BEST_EFFORT)
"""States wait here until a method waits."""
_STATE = JOINT_STATES, HAND_POSE, LIMIT_DISTANCES
_SETTLED = 2.0
"""After which diagnostics are about the goal that was sent, s; they come twice a second, and the
arm stands for 1 s before it counts as short of its goal."""


class NotReachedError(ArmSafetyError, RuntimeError):
    """The arm is not where it was sent; the text says why, as far as the controller knows."""


class ArmState(NamedTuple):
    """State of the arm, and how far inside its limits it is."""

    q: Array
    """Shape (n,), rad."""
    v: Array
    """Shape (n,), rad/s."""
    tau: Array
    """Torque of the motors, shape (n,), N m; NaN where the robot does not tell."""
    hand: pin.SE3
    """Pose of the hand in the base frame."""
    margins: tuple[Array, Array, Array]
    """Distances to the limits of position, rad, speed, rad/s, and torque, N m; shape (n,) each."""


class StateRecording:
    """States of an arm in the order of their stamps; N of n joints. Some may be lost.

    Args:
        joints: names of the n joints.
        continuous: see `JointStateReader`; their angles do not leap, whatever the driver reports.
    """

    def __init__(self, joints: Sequence[str], continuous: NDArray[np.bool_] | None = None) -> None:
        self._reader = JointStateReader(joints, needs_velocities=False, continuous=continuous)
        self._joints, self._n = list(joints), len(joints)
        self._stamps: list[int] = []
        self._states: list[tuple[Array, Array, Array]] = []

    def add(self, message: JointState) -> None:
        """Keep the state in a message that has come, if it can be used."""
        reader = self._reader
        if reader.read(message, time.monotonic()) is Arrival.NEW:
            tau = reader.effort()
            self._stamps.append(reader.stamp)
            unknown = np.full(self._n, math.nan)
            self._states.append((reader.q, reader.v, unknown if tau is None else tau))

    @property
    def t(self) -> Array:
        """Time of the robot since the first state, shape (N,), s."""
        stamps = np.array(self._stamps, dtype=np.int64)
        return 1e-9 * (stamps - stamps[:1]).astype(float)

    @property
    def q(self) -> Array:
        """Positions, shape (N, n), rad."""
        return self._column(0)

    @property
    def v(self) -> Array:
        """Velocities, shape (N, n), rad/s."""
        return self._column(1)

    @property
    def tau(self) -> Array:
        """Torques of the motors, shape (N, n), N m; NaN where the robot does not tell."""
        return self._column(2)

    def save(self, path: str | PathLike[str]) -> None:
        """Write joints, t, q, v and tau to an ``npz`` file."""
        joints = np.array(self._joints)
        np.savez_compressed(path, joints=joints, t=self.t, q=self.q, v=self.v, tau=self.tau)

    def _column(self, which: int) -> Array:
        return np.array([state[which] for state in self._states]).reshape(-1, self._n)


class ArmClient:
    """Connects to a controller that runs, and drives its arm.

    Give it to a ``with`` statement: it leaves ROS when that ends. Callbacks run only while a
    method waits.

    Args:
        joints: names of the n joints, in the order of all arrays.
        timeout: how long the arm may be silent, s.

    Raises:
        NotReachedError: no robot, or no controller, is heard.
    """

    def __init__(self, joints: Sequence[str], timeout: float = 30.0) -> None:
        self._joints, self._timeout = list(joints), timeout
        self._heard: dict[str, Any] = {}
        self._status: dict[str, str] = {}
        self._status_at = -math.inf
        self._context = rclpy.Context()
        rclpy.init(context=self._context)
        self._node = Node("arm_client", context=self._context, start_parameter_services=False)
        self._executor = make_executor(self._context)
        self._executor.add_node(self._node)
        for topic in _STATE:
            topic.subscription(self._node, partial(self._heard.__setitem__, topic.name))
        DIAGNOSTICS.subscription(self._node, self._on_diagnostics)
        self._poses = TARGET_POSE.publisher(self._node)
        self._trajectories = TARGET_JOINT_TRAJECTORY.publisher(self._node)
        self._pushes = self._node.create_publisher(WrenchStamped, "external_wrench", GOAL_QOS)
        try:
            self._wait(self._has_controller, timeout, "no controller is heard")
            self.state()
        except NotReachedError:
            self.close()
            raise

    def __enter__(self) -> ArmClient:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Leave ROS; the arm keeps its last goal."""
        self._node.destroy_node()
        self._executor.shutdown()
        rclpy.try_shutdown(context=self._context)

    def _has_controller(self) -> bool:
        topics = TARGET_POSE.name, TARGET_JOINT_TRAJECTORY.name
        return all(is_subscribed(self._node, topic, "controller_node") for topic in topics)

    def state(self) -> ArmState:
        """Return the next state that comes."""
        self._heard.clear()
        for topic in _STATE:
            name = topic.name
            self._wait(
                partial(self._heard.__contains__, name), self._timeout, f"nothing on '{name}'"
            )
        (q, v, tau), margins = map(self._by_joint, (JOINT_STATES, LIMIT_DISTANCES))
        if np.isnan(q).any():
            missing = self._joints[int(np.isnan(q).argmax())]
            hint = did_you_mean(missing, self._heard[JOINT_STATES.name].name)
            raise NotReachedError(f"the robot does not tell where '{missing}' is{hint}")
        return ArmState(q, v, tau, self._hand(), margins)

    def move_to(
        self,
        pose: pin.SE3,
        timeout: float = 30.0,
        tolerance: tuple[float, float] = (0.005, 0.02),
    ) -> None:
        """Send the hand to a pose in the base frame, and wait until it is there.

        Args:
            pose: where to.
            timeout: how long to wait, s.
            tolerance: of translation, m, and rotation, rad.

        Raises:
            NotReachedError: it is not there, or it stands short of it.
        """

        def there() -> bool:
            if HAND_POSE.name not in self._heard:
                return False
            between = pose.actInv(self._hand())
            away = np.linalg.norm(between.translation), np.linalg.norm(pin.log3(between.rotation))
            return bool(away[0] < tolerance[0] and away[1] < tolerance[1])

        self._poses.publish(pose_message(pose))
        self._arrive(there, timeout)

    def move_joints(
        self,
        q: Sequence[float] | Array,
        duration: float,
        timeout: float = 30.0,
        near: float = 0.01,
    ) -> None:
        """Send the joints to positions, and wait until they are there.

        Args:
            q: where to, shape (n,), rad; those of continuous joints in any turn.
            duration: of the motion, s of the robot's time.
            timeout: how long to wait, s.
            near: distance of each joint that counts as there, rad.

        Raises:
            NotReachedError: they are not there.
        """
        target = np.asarray(q, dtype=float)
        point = JointTrajectoryPoint(positions=target.tolist())
        set_stamp(point.time_from_start, round(1e9 * duration))

        def there() -> bool:
            if not {JOINT_STATES.name, LIMIT_DISTANCES.name} <= self._heard.keys():
                return False
            q, distance = (self._by_joint(each)[0] for each in (JOINT_STATES, LIMIT_DISTANCES))
            nearest = target + whole_turns(target, q, np.isinf(distance))
            return bool(np.abs(q - nearest).max() < near)

        self._trajectories.publish(JointTrajectory(joint_names=self._joints, points=[point]))
        self._arrive(there, timeout)

    def push(self, link: str, force: Sequence[float]) -> None:
        """Push a link of the simulated robot, N in world axes, until another push of it.

        Args:
            link: its name.
            force: shape (3,); zeros end the push.
        """
        self._wait(
            lambda: is_subscribed(self._node, "external_wrench", "bullet_node"),
            self._timeout,
            "no simulated robot is heard",
        )
        self._pushes.publish(wrench_message(link, force))

    @contextmanager
    def record(self) -> Iterator[StateRecording]:
        """Keep the states that come while methods of this client wait, in a ``with`` statement."""
        recording = StateRecording(self._joints, np.isinf(self.state().margins[0]))
        subscription = self._node.create_subscription(
            JointState, JOINT_STATES.name, recording.add, _RECORDING_QOS
        )
        try:
            yield recording
        finally:
            self._node.destroy_subscription(subscription)

    def wait(self, duration: float) -> None:
        """Let time pass, s."""
        end = time.monotonic() + duration
        self._wait(lambda: time.monotonic() >= end, math.inf, "")

    def _arrive(self, there: Callable[[], bool], timeout: float) -> None:
        sent, before = time.monotonic(), self._status.get("goals_refused", "none")
        self._heard.clear()

        def over() -> bool:
            if there():
                return True
            refused = self._status.get("goals_refused", before)
            if refused not in (before, "none"):  # none after a restart of the controller
                raise NotReachedError(f"the controller refused it: {refused} its log says why")
            now = time.monotonic()
            if now - sent > _SETTLED:
                if now - self._status_at > _SETTLED:
                    raise NotReachedError("the controller is silent")
                if self._status.get("mode", "TRACKING") != "TRACKING":
                    raise NotReachedError(self._status["message"])
                if (short := self._status.get("short_of_goal", "none")) != "none":
                    raise NotReachedError(f"it {short}")
            return False

        self._wait(over, timeout, "it is still on its way")

    def _wait(self, condition: Callable[[], bool], timeout: float, otherwise: str) -> None:
        end = time.monotonic() + timeout
        while not condition():
            if time.monotonic() > end:
                raise NotReachedError(f"after {timeout:g} s: {otherwise}")
            self._executor.spin_once(timeout_sec=0.02)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name == "controller_node":  # not that of another arm in a namespace
                self._status_at = time.monotonic()
                self._status = {pair.key: pair.value for pair in status.values}
                self._status["message"] = status.message

    def _by_joint(self, topic: Topic) -> tuple[Array, Array, Array]:
        """Return positions, velocities and efforts heard last, shape (n,) each; NaN if missing."""
        message: JointState = self._heard[topic.name]
        parts = []
        for values in (message.position, message.velocity, message.effort):
            where = dict(zip(message.name, values, strict=False))
            parts.append(np.array([where.get(joint, math.nan) for joint in self._joints]))
        return parts[0], parts[1], parts[2]

    def _hand(self) -> pin.SE3:
        pose = self._heard[HAND_POSE.name].pose
        o = pose.orientation
        turn = pin.Quaternion(o.w, o.x, o.y, o.z).toRotationMatrix()
        return pin.SE3(turn, numbers_of(pose.position))
