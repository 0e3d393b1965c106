# SPDX-License-Identifier: Apache-2.0
"""Subscribes to the topics of robot, bounds and controller, and records them."""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import WrenchStamped
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory

from sim_bridge.scenario.recording import Array, RecordedRun
from viability_bounds_pkg.ros.messages import JointStateReader, Verdict
from viability_bounds_pkg.ros.runtime import stamp_to_ns
from viability_bounds_pkg.ros.topics import (
    ACCELERATION_LIMITS,
    FT_WRENCH,
    JOINT_COMMANDS,
    JOINT_STATES,
)

_RECORDING_QOS = QoSProfile(depth=20_000, reliability=ReliabilityPolicy.BEST_EFFORT)


class RunListener:
    """Records the messages of robot, bounds and controller by their stamps, in any order.

    Args:
        node: subscribes.
        joints: joints to record, in this order.

    Attributes:
        topics: names of those recorded.
        stamp: of the last state, ns; -1 before the first.
        q: positions in it, shape (n,), rad.
        answered: stamp of the last command, ns; -1 before the first.
        diagnostics: the last ones of each node in the namespace of `node`, values by key, by node
            name.
    """

    def __init__(self, node: Node, joints: Sequence[str]) -> None:
        self.stamp = self.answered = -1
        self.q: Array = np.zeros(len(joints))
        self.diagnostics: dict[str, dict[str, str]] = {
            name: {} for name in ("bullet_node", "controller_node", "bounds_node")
        }
        namespace = node.get_namespace().strip("/")
        self._senders = {
            f"{namespace}/{name}" if namespace else name: name for name in self.diagnostics
        }
        self.topics: tuple[str, ...] = ()
        self._joints = tuple(joints)
        self._reader = JointStateReader(joints)
        self._states: dict[int, tuple[Array, Array]] = {}
        self._limits: dict[int, list[Sequence[float]]] = {}
        self._torques: dict[int, Sequence[float]] = {}
        self._wrenches: dict[int, Sequence[float]] = {}
        for topic, take in (
            (JOINT_STATES, self._on_state),
            (ACCELERATION_LIMITS, self._on_limits),
            (JOINT_COMMANDS, self._on_command),
            (FT_WRENCH, self._on_wrench),
        ):
            node.create_subscription(topic.message, topic.name, take, _RECORDING_QOS)
            self.topics += (topic.name,)
        node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 100)

    def run(self, first: int) -> RecordedRun:
        """Return the recording from the state with stamp `first` on."""
        stamps = sorted(stamp for stamp in self._states if stamp >= first)
        nan = [np.nan] * len(self._joints)
        states = np.array([self._states[s] for s in stamps])
        limits = np.array([self._limits.get(s, (nan, nan)) for s in stamps])
        return RecordedRun(
            joints=self._joints,
            t=(np.array(stamps) - first) * 1e-9,
            q=states[:, 0],
            v=states[:, 1],
            a_lower=limits[:, 0],
            a_upper=limits[:, 1],
            tau=np.array([self._torques.get(s) or nan for s in stamps]),
            ft_wrench=np.array([self._wrenches.get(s, [np.nan] * 6) for s in stamps]),
            answered=np.array([s in self._torques for s in stamps]),
        )

    def _on_state(self, message: JointState) -> None:
        if self._reader.read(message, time.monotonic()) is Verdict.NEW:
            self.stamp, self.q = self._reader.stamp, self._reader.q
            self._states[self.stamp] = self.q, self._reader.v

    def _on_limits(self, message: JointTrajectory) -> None:
        limits = [point.accelerations for point in message.points]
        self._limits[stamp_to_ns(message.header.stamp)] = limits

    def _on_command(self, message: JointState) -> None:
        self.answered = stamp_to_ns(message.header.stamp)
        self._torques.setdefault(self.answered, message.effort)

    def _on_wrench(self, message: WrenchStamped) -> None:
        f, t = message.wrench.force, message.wrench.torque
        self._wrenches[stamp_to_ns(message.header.stamp)] = f.x, f.y, f.z, t.x, t.y, t.z

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if sender := self._senders.get(status.name):
                values = {value.key: value.value for value in status.values}
                self.diagnostics[sender] = values
