# SPDX-License-Identifier: Apache-2.0
"""Nodes that only relay messages, in place of bounds and controller; as a program with a robot.

What the real chain takes longer than these is the work of its nodes.
"""

from __future__ import annotations

import sys
from array import array
from collections.abc import Iterator
from typing import Any

from rclpy.node import Node
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from sim_bridge.nodes.bullet_node import BulletNode
from viability_bounds_pkg.ros.direct_delivery import DirectDelivery
from viability_bounds_pkg.ros.program import run_together, stack_parser
from viability_bounds_pkg.ros.topics import ACCELERATION_LIMITS, JOINT_COMMANDS, JOINT_STATES


class Relay(Node):
    """A node that takes part in direct delivery."""

    def __init__(
        self, name: str, direct_delivery: DirectDelivery | None = None, **arguments: Any
    ) -> None:
        super().__init__(name, **arguments)
        self.direct_delivery = direct_delivery

    def topics_used(self) -> list[tuple[str, ...]]:
        """Return nothing that a program has to look at."""
        return []


class RelayLimits(Relay):
    """Answers a state with limits of the right size, and does nothing else."""

    def __init__(self, joints: list[str], **arguments: Any) -> None:
        super().__init__("relay_limits", **arguments)
        wide = array("d", [1.0] * len(joints))
        self._answer = JointTrajectory(
            joint_names=joints,
            points=[JointTrajectoryPoint(accelerations=wide) for _ in range(2)],
        )
        self._publisher = ACCELERATION_LIMITS.publisher(self)
        JOINT_STATES.subscription(self, self._on_state)

    def _on_state(self, message: JointState) -> None:
        self._answer.header.stamp = message.header.stamp
        self._publisher.publish(self._answer)


class RelayCommand(Relay):
    """Takes states and limits, answers limits with a command of the right size."""

    def __init__(self, joints: list[str], **arguments: Any) -> None:
        super().__init__("relay_command", **arguments)
        self._command = JointState(name=joints, effort=array("d", [0.0] * len(joints)))
        self._publisher = JOINT_COMMANDS.publisher(self)
        JOINT_STATES.subscription(self, lambda _: None)
        ACCELERATION_LIMITS.subscription(self, self._on_limits)

    def _on_limits(self, message: JointTrajectory) -> None:
        self._command.header.stamp = message.header.stamp
        self._publisher.publish(self._command)


def make_nodes(delivery: DirectDelivery) -> Iterator[Any]:
    """Make the simulated robot, and the relays that answer it."""
    robot = BulletNode(direct_delivery=delivery)
    yield robot
    joints = list(robot.get_parameter("joints").value)
    yield RelayLimits(joints, direct_delivery=delivery)
    yield RelayCommand(joints, direct_delivery=delivery)


if __name__ == "__main__":
    sys.exit(run_together(stack_parser("relays", __doc__ or "", [BulletNode]), make_nodes))
