# SPDX-License-Identifier: Apache-2.0
"""Subscribes to the topics of robot, bounds and controller, and records them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import WrenchStamped
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory

from sim_bridge.scenario.recording import Recorder
from viability_bounds_pkg.ros.runtime import stamp_to_ns

_RECORDING_QOS = QoSProfile(depth=20_000, reliability=ReliabilityPolicy.BEST_EFFORT)


class RunListener:
    """Records the messages of robot, bounds and controller.

    Args:
        node: subscribes.
        joints: joints to record, in this order.

    Attributes:
        recorder: the recording.
        stamp: of the last state, ns.
        q: its positions, shape (n,), rad; None before the first.
        answered: stamp of the last command, ns; -1 before the first.
        diagnostics: the last ones of each node, values by key, by node name.
    """

    def __init__(self, node: Node, joints: Sequence[str]) -> None:
        self.recorder = Recorder(joints)
        self.stamp = 0
        self.q: np.ndarray | None = None
        self.answered = -1
        self.diagnostics: dict[str, dict[str, str]] = {
            name: {} for name in ("bullet_node", "controller_node", "bounds_node")
        }
        self._joints = tuple(joints)
        self._index: list[int] | None = None
        for kind, topic, take in (
            (JointState, "joint_states", self._on_state),
            (JointTrajectory, "acceleration_limits", self._on_limits),
            (JointState, "joint_commands", self._on_command),
            (WrenchStamped, "ft_wrench", self._on_wrench),
        ):
            node.create_subscription(kind, topic, take, _RECORDING_QOS)
        node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 100)

    def _on_state(self, message: JointState) -> None:
        if self._index is None:
            where = {name: i for i, name in enumerate(message.name)}
            if any(joint not in where for joint in self._joints):
                return
            self._index = [where[joint] for joint in self._joints]
        q = [message.position[i] for i in self._index]
        self.q, self.stamp = np.array(q), stamp_to_ns(message.header.stamp)
        self.recorder.add_state(self.stamp, q, [message.velocity[i] for i in self._index])

    def _on_limits(self, message: JointTrajectory) -> None:
        lower, upper = (point.accelerations for point in message.points)
        self.recorder.add_limits(stamp_to_ns(message.header.stamp), lower, upper)

    def _on_command(self, message: JointState) -> None:
        self.answered = stamp_to_ns(message.header.stamp)
        self.recorder.add_torque(self.answered, message.effort)

    def _on_wrench(self, message: WrenchStamped) -> None:
        f, t = message.wrench.force, message.wrench.torque
        stamp = stamp_to_ns(message.header.stamp)
        self.recorder.add_wrench(stamp, (f.x, f.y, f.z, t.x, t.y, t.z))

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name in self.diagnostics:
                values = {value.key: value.value for value in status.values}
                self.diagnostics[status.name] = values
