# SPDX-License-Identifier: Apache-2.0
"""Publishes distances to the limits, and slow copies of the streams."""

from __future__ import annotations

import time
from array import array

import numpy as np
from rclpy.node import Node
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory

from viability_bounds_pkg.node.bounds_parameters import BoundsConfiguration
from viability_bounds_pkg.ros.messages import JointStateReader
from viability_bounds_pkg.ros.runtime import set_stamp, steady_timer
from viability_bounds_pkg.ros.topics import (
    LIMIT_DISTANCES,
    SLOW_ACCELERATION_LIMITS,
    SLOW_JOINT_STATES,
)

_PERIOD = 0.05


class SlowTopics:
    """Publishes by a timer of its own what is subscribed to; answers to states do no work for it.

    Args:
        node: publishes.
        config: names and limits.
        states: has the last joint state.
        limits: the last answer, with its numbers changed at each.
    """

    def __init__(
        self,
        node: Node,
        config: BoundsConfiguration,
        states: JointStateReader,
        limits: JointTrajectory,
    ) -> None:
        self._config, self._states, self._limits = config, states, limits
        self._message = JointState(name=list(config.joints))
        self._distances = LIMIT_DISTANCES.publisher(node)
        self._slow_states = SLOW_JOINT_STATES.publisher(node)
        self._slow_limits = SLOW_ACCELERATION_LIMITS.publisher(node)
        steady_timer(node, _PERIOD, self._publish)

    def _publish(self) -> None:
        if time.monotonic() - self._states.heard_at > self._config.state_timeout:
            return
        if self._slow_states.get_subscription_count():
            self._slow_states.publish(self._states.message)
        if self._slow_limits.get_subscription_count():
            self._slow_limits.publish(self._limits)
        if self._distances.get_subscription_count():
            self._publish_distances()

    def _publish_distances(self) -> None:
        config, states, message = self._config, self._states, self._message
        q, tau = states.q, states.effort()
        distances = np.minimum(q - config.position_min, config.position_max - q)
        message.position = array("d", distances.tobytes())
        message.velocity = array("d", (config.velocity_max - np.abs(states.v)).tobytes())
        if tau is not None and len(config.torque_max):
            message.effort = array("d", (config.torque_max - np.abs(tau)).tobytes())
        else:
            message.effort = array("d")
        set_stamp(message.header.stamp, states.stamp)
        self._distances.publish(message)
