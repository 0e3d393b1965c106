# SPDX-License-Identifier: Apache-2.0
"""Publishes for tools by how much the joints are inside their limits."""

from __future__ import annotations

import time
from array import array

import numpy as np
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from sensor_msgs.msg import JointState

from viability_bounds_pkg.node.bounds_parameters import BoundsConfiguration
from viability_bounds_pkg.ros.messages import JointStateReader
from viability_bounds_pkg.ros.runtime import set_stamp
from viability_bounds_pkg.ros.topics import LIMIT_DISTANCES

_PERIOD = 0.05


class LimitDistances:
    """Publishes ``limit_distances`` by a timer of its own, where it is subscribed to.

    Args:
        node: publishes.
        config: names and limits.
        states: has the last joint state.
    """

    def __init__(self, node: Node, config: BoundsConfiguration, states: JointStateReader) -> None:
        self._config, self._states = config, states
        self._message = JointState(name=list(config.joints))
        self._publisher = LIMIT_DISTANCES.publisher(node)
        # The steady clock, as with use_sim_time the other one may be slower than the robot.
        node.create_timer(_PERIOD, self._publish, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _publish(self) -> None:
        config, states, message = self._config, self._states, self._message
        silent = time.monotonic() - states.heard_at > config.state_timeout
        if silent or not self._publisher.get_subscription_count():
            return
        q, tau = states.q, states.effort()
        distances = np.minimum(q - config.position_min, config.position_max - q)
        message.position = array("d", distances.tobytes())
        message.velocity = array("d", (config.velocity_max - np.abs(states.v)).tobytes())
        if tau is not None and len(config.torque_max):
            message.effort = array("d", (config.torque_max - np.abs(tau)).tobytes())
        else:
            message.effort = array("d")
        set_stamp(message.header.stamp, states.stamp)
        self._publisher.publish(message)
