# SPDX-License-Identifier: Apache-2.0
"""Imperfect robots and the nodes that know what is wrong with them, in lockstep."""

import pytest
from sensor_msgs.msg import JointState

from torque_safety_controller.node.controller_node import ControllerNode
from viability_bounds_pkg.node.bounds_node import BoundsNode
from viability_bounds_pkg.testing.ros_harness import read_config


@pytest.mark.parametrize(
    ("kind", "name"), [(BoundsNode, "bounds_node"), (ControllerNode, "controller_node")]
)
def test_nodes_say_that_the_estimator_is_missing(ros, kind, name):
    node = ros.start(kind, read_config("panda", name) | {"use_estimated_states": True})
    ros.probe.create_publisher(JointState, "joint_states", 1)
    ros.wait_until(lambda: node.count_publishers("joint_states"), "the robot")
    for _ in range(3):
        node.publisher_watch.look()
    node._diagnostics.publish()
    missing = "'/joint_states' has a publisher, '/estimated_joint_states' has none"
    ros.wait_until(lambda: missing in ros.reported(name, "message"), "the message")
