# SPDX-License-Identifier: Apache-2.0
"""Nodes that only relay messages, in place of bounds and controller; as a program with a robot.

What the real chain takes longer than these is the work of its nodes.
"""

from __future__ import annotations

import sys
from array import array
from collections.abc import Iterator
from typing import Any

from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from sim_bridge.node.bullet_node import BulletNode
from viability_bounds_pkg.ros.arm_node import ArmNode
from viability_bounds_pkg.ros.program import run_together, stack_parser
from viability_bounds_pkg.ros.topics import ACCELERATION_LIMITS, JOINT_COMMANDS, JOINT_STATES


class RelayLimits(ArmNode):
    """Answers a state with limits of the right size, and does nothing else."""

    NAME = "relay_limits"

    def __init__(self, joints: list[str], **arguments: Any) -> None:
        super().__init__(**arguments)
        wide = array("d", [1.0] * len(joints))
        self._answer = JointTrajectory(
            joint_names=joints,
            points=[JointTrajectoryPoint(accelerations=wide) for _ in range(2)],
        )
        self._publisher = self.stream(ACCELERATION_LIMITS)
        self.listen(JOINT_STATES, self._on_state)

    def _on_state(self, message: JointState) -> None:
        self._answer.header.stamp = message.header.stamp
        self._publisher.publish(self._answer)


class RelayCommand(ArmNode):
    """Takes states and limits, answers limits with a command of the right size."""

    NAME = "relay_command"

    def __init__(self, joints: list[str], **arguments: Any) -> None:
        super().__init__(**arguments)
        self._command = JointState(name=joints, effort=array("d", [0.0] * len(joints)))
        self._publisher = self.stream(JOINT_COMMANDS)
        self.listen(JOINT_STATES, lambda _: None)
        self.listen(ACCELERATION_LIMITS, self._on_limits)

    def _on_limits(self, message: JointTrajectory) -> None:
        self._command.header.stamp = message.header.stamp
        self._publisher.publish(self._command)


def make_nodes() -> Iterator[Any]:
    """Make the simulated robot, and the relays that answer it."""
    robot = BulletNode()
    yield robot
    joints = list(robot.get_parameter("joints").value)
    yield RelayLimits(joints)
    yield RelayCommand(joints)


if __name__ == "__main__":
    sys.exit(run_together(stack_parser("relays", __doc__ or "", [BulletNode]), make_nodes))
