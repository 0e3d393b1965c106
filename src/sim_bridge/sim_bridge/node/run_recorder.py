# SPDX-License-Identifier: Apache-2.0
"""Subscribes to the topics of robot, bounds and controller, and records them."""

from __future__ import annotations

import struct
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, WrenchStamped
from numpy.typing import NDArray
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory, MultiDOFJointTrajectory

from sim_bridge.mcap_file import McapFile
from sim_bridge.node.topics import EXTERNAL_WRENCH, OBSTACLES, RECORDED
from sim_bridge.scenario.report import Array, RecordedRun
from viability_bounds_pkg.ros.arm_node import ArmNode
from viability_bounds_pkg.ros.messages import Arrival, JointOrder, JointStateReader, wrench_numbers
from viability_bounds_pkg.ros.runtime import LATCHED_QOS, stamp_to_ns
from viability_bounds_pkg.ros.topics import (
    ACCELERATION_LIMITS,
    DIAGNOSTICS,
    FT_WRENCH,
    JOINT_COMMANDS,
    JOINT_STATES,
    LIMIT_DISTANCES,
    ROBOT_DESCRIPTION,
)

_RECORDING_QOS = QoSProfile(depth=20_000, reliability=ReliabilityPolicy.BEST_EFFORT)

_TOLD_EACH = 5
"""States after which the robot is told that they are recorded."""

_MANY = QoSProfile(depth=100)
_FURTHER: tuple[tuple[str, type, QoSProfile], ...] = (
    ("hand_pose", PoseStamped, _MANY),
    (LIMIT_DISTANCES.name, LIMIT_DISTANCES.message, _MANY),
    ("controller_mode", String, LATCHED_QOS),
    (ROBOT_DESCRIPTION.name, ROBOT_DESCRIPTION.message, LATCHED_QOS),
    ("target_pose", PoseStamped, _MANY),
    ("target_posture", JointState, _MANY),
    ("target_trajectory", MultiDOFJointTrajectory, _MANY),
    ("target_wrench", WrenchStamped, _MANY),
    (EXTERNAL_WRENCH.name, EXTERNAL_WRENCH.message, _MANY),
    (OBSTACLES.name, OBSTACLES.message, _MANY),
)
"""Further topics that are written to a file; the report does not need them."""


def _stamp_of(serialized: bytes) -> int:
    """Return the stamp, ns, of a serialized message that begins with a header."""
    seconds, nanoseconds = struct.unpack_from("<iI", serialized, 4)
    return int(seconds) * 1_000_000_000 + int(nanoseconds)


class RunRecorder:
    """Records the messages of robot, bounds and controller by their stamps, in any order.

    It tells a robot in lockstep what it has, which therefore waits for it.

    Args:
        node: subscribes.
        joints: joints to record, in this order.
        continuous: see `JointStateReader`; recorded without leaps.
        file: to which all messages go, too, as they came; None for none.
        robot: name of the robot's node.

    Attributes:
        topics: names of those recorded.
        stamp: of the last state, ns; -1 before the first.
        q: positions in it, shape (n,), rad.
        answered: stamp of the last command, ns; -1 before the first.
        diagnostics: the last ones of each node in the namespace of `node`, values by key, by node
            name.
    """

    def __init__(
        self,
        node: ArmNode,
        joints: Sequence[str],
        continuous: NDArray[np.bool_],
        file: McapFile | None = None,
        robot: str = "bullet_node",
    ) -> None:
        self._unfiled: list[tuple[str, bytes]] = []
        self.stamp = self.answered = -1
        self.q: Array = np.zeros(len(joints))
        self.diagnostics: dict[str, dict[str, str]] = {
            name: {} for name in (robot, "controller_node", "bounds_node")
        }
        namespace = node.get_namespace().strip("/")
        self._senders = {
            f"{namespace}/{name}" if namespace else name: name for name in self.diagnostics
        }
        self.topics: tuple[str, ...] = ()
        self._joints = tuple(joints)
        self._reader = JointStateReader(joints, needs_velocities=False, continuous=continuous)
        self._states: dict[int, tuple[Array, Array]] = {}
        self._order_of_limits, self._order_of_commands = JointOrder(joints), JointOrder(joints)
        self._limits: dict[int, list[Array]] = {}
        self._torques: dict[int, Array] = {}
        self._wrenches: dict[int, Array] = {}
        self._recorded = RECORDED.publisher(node)
        for topic, callback in (
            (JOINT_STATES, self._on_state),
            (ACCELERATION_LIMITS, self._on_limits),
            (JOINT_COMMANDS, self._on_command),
            (FT_WRENCH, self._on_wrench),
        ):
            self.topics += (topic.name,)
            if file is None:
                named = joints if topic is JOINT_STATES else ()
                node.listen(topic, callback, _RECORDING_QOS, named)
            else:
                self._keep(file, node, topic.message, topic.name, callback, _RECORDING_QOS)
                node.publisher_watch.add(node.resolve_topic_name(topic.name))
        if file is None:
            DIAGNOSTICS.subscription(node, self._on_diagnostics)
            return
        self._keep(file, node, DiagnosticArray, "/diagnostics", self._on_diagnostics, _MANY)
        for name, kind, qos in _FURTHER:
            self._keep(file, node, kind, name, None, qos)

    def _keep(
        self,
        file: McapFile,
        node: ArmNode,
        kind: type,
        name: str,
        callback: Callable[[Any], None] | None,
        qos: QoSProfile,
    ) -> None:
        """Subscribe; each message is written to the file and passed to `callback`."""
        path = node.resolve_topic_name(name)
        file.add_topic(path, kind)

        def keep(serialized: bytes) -> None:
            if callback is not None:
                callback(deserialize_message(serialized, kind))
            stamp = _stamp_of(serialized)
            if name not in self.topics:
                # Without a stamp of robot time, or with one in the future.
                self._unfiled.append((path, serialized))
                stamp = self.stamp
            else:
                file.write(path, serialized, stamp)
            if stamp >= 0:  # of the last state; before the first one there is none to file under
                for each, content in self._unfiled:
                    file.write(each, content, stamp)
                self._unfiled.clear()

        node.create_subscription(kind, name, keep, qos, raw=True)

    def run(self, first: int, period: int, periods: int) -> RecordedRun:
        """Return the recording of a number of periods, ns, from the stamp `first` on."""
        stamps = [first + k * period for k in range(periods)]
        nan = [np.nan] * len(self._joints)
        states = np.array([self._states.get(s, (nan, nan)) for s in stamps])
        limits = np.array([self._limits.get(s, (nan, nan)) for s in stamps])
        return RecordedRun(
            joints=self._joints,
            t=(np.array(stamps) - first) * 1e-9,
            q=states[:, 0],
            v=states[:, 1],
            a_lower=limits[:, 0],
            a_upper=limits[:, 1],
            tau=np.array([self._torques.get(s, nan) for s in stamps]),
            ft_wrench=np.array([self._wrenches.get(s, np.full(6, np.nan)) for s in stamps]),
            answered=np.array([s in self._torques for s in stamps]),
        )

    def _on_state(self, message: JointState) -> None:
        arrival = self._reader.read(message, time.monotonic())
        if arrival is Arrival.REFUSED:
            return
        if arrival is Arrival.NEW:
            self.stamp, self.q = self._reader.stamp, self._reader.q
            self._states[self.stamp] = self.q, self._reader.v
        if arrival is Arrival.REPEATED or len(self._states) % _TOLD_EACH == 0:
            self._recorded.publish(message.header)

    def _on_limits(self, message: JointTrajectory) -> None:
        parts = [point.accelerations for point in message.points]
        limits = _by_joint(self._order_of_limits, message.joint_names, parts)
        if len(limits) == 2:
            self._limits[stamp_to_ns(message.header.stamp)] = limits

    def _on_command(self, message: JointState) -> None:
        self.answered = stamp_to_ns(message.header.stamp)
        unknown = np.full(len(self._joints), np.nan)  # as of the drives' position control
        found = _by_joint(self._order_of_commands, message.name, [message.effort])
        self._torques.setdefault(self.answered, found[0] if found else unknown)

    def _on_wrench(self, message: WrenchStamped) -> None:
        self._wrenches[stamp_to_ns(message.header.stamp)] = wrench_numbers(message)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if sender := self._senders.get(status.name):
                values = {value.key: value.value for value in status.values}
                self.diagnostics[sender] = values


def _by_joint(
    order: JointOrder, names: Sequence[str], parts: Sequence[Sequence[float]]
) -> list[Array]:
    """Return numbers of a message in the order of the joints; none if it lacks any."""
    if any(len(part) != len(names) for part in parts) or order.find(names)[0]:
        return []
    return [np.array(part)[order.index] for part in parts]
