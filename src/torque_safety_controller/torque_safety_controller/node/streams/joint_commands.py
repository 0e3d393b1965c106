# SPDX-License-Identifier: Apache-2.0
"""Commands to the robot: torques, or positions for the robot's own drives."""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from typing import Any

import numpy as np
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from torque_safety_controller.node.topics import ROS2_CONTROL_EFFORTS
from viability_bounds_pkg.ros.arm_node import ArmNode
from viability_bounds_pkg.ros.runtime import stamp_to_ns
from viability_bounds_pkg.ros.topics import JOINT_COMMANDS


class JointCommands:
    """Publishes ``joint_commands``, and torques for ros2_control where that is asked for.

    Args:
        node: the publishing node.
        joints: names of the n joints.
        ros2_control_topic: of the torques in `joints` order; empty for none.
    """

    def __init__(self, node: ArmNode, joints: Sequence[str], ros2_control_topic: str) -> None:
        self._torques = JointState(name=list(joints))
        self._positions = JointState(
            name=list(joints), velocity=array("d", np.zeros(len(joints)).tobytes())
        )
        self._last = self._torques
        self._commands = node.stream(JOINT_COMMANDS)
        self._efforts = None
        if ros2_control_topic:
            self._efforts = ROS2_CONTROL_EFFORTS.publisher(node, ros2_control_topic)
            node.publisher_watch.add(self._efforts.topic_name)

    @property
    def stamp(self) -> int:
        """Stamp of the state answered last, ns."""
        return stamp_to_ns(self._last.header.stamp)

    def torque(self, tau: np.ndarray, stamp: Any) -> None:
        """Send torques, shape (n,), N m, for the state with `stamp`."""
        self._torques.effort = array("d", tau.tobytes())
        self._last = self._torques
        self.again(stamp)

    def position(self, q: np.ndarray, stamp: Any) -> None:
        """Have the drives hold positions, shape (n,), rad, from the state with `stamp` on."""
        self._positions.position = array("d", q.tobytes())
        self._last = self._positions
        self.again(stamp)

    def again(self, stamp: Any) -> None:
        """Send the last command again, torques or positions, because a state was repeated."""
        self._last.header.stamp = stamp
        self._commands.publish(self._last)
        if self._efforts is not None and self._last is self._torques:
            self._efforts.publish(Float64MultiArray(data=self._torques.effort))
