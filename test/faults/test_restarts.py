# SPDX-License-Identifier: Apache-2.0
"""Nodes that end in the middle of a motion and start again, in lockstep."""

import numpy as np
from sensor_msgs.msg import JointState

from sim_bridge.node.bullet_node import RETRY_PERIOD, BulletNode
from torque_safety_controller.node.controller_node import QUIET, ControllerNode
from torque_safety_controller.parameters.controller_parameters import ControllerConfiguration
from viability_bounds_pkg.node.bounds_node import BoundsNode
from viability_bounds_pkg.parameter import parameter_table
from viability_bounds_pkg.ros.program import SIGNAL_CHECK_PERIOD
from viability_bounds_pkg.ros.runtime import GOAL_QOS
from viability_bounds_pkg.testing.ros_harness import joint_state, read_config

KINDS = (BulletNode, BoundsNode, ControllerNode)
VALUES = read_config("baxter_left_arm", *(kind.NAME for kind in KINDS)) | {"clock": "lockstep"}
VALUES |= {"posture_kp": 25.0, "posture_kd": 10.0, "posture_weight": 1.0, "pose_weight": 0.0}
START = np.array(VALUES["start_positions"])
TURN = np.array([0.3, 0.0, 0.3, 0.3, 0.3, 0.3, 0.3])  # rad


def test_an_arm_whose_nodes_start_again_goes_on(ros):
    robot, *others = (ros.start(kind, VALUES) for kind in KINDS)
    user = ros.talk(JointState, "target_posture", GOAL_QOS)

    def off(goal):
        return np.abs(robot.true_positions - goal).max()

    def go_to(goal, within):
        ask = joint_state(VALUES["joints"], 0, goal)
        ros.wait_until(
            lambda: off(goal) < within, "the goal", 120.0, lambda: user.publish(ask), period=0.2
        )

    for node, goal in zip(others, (START + TURN, START - TURN), strict=True):
        go_to(goal, within=0.2)
        ros.stop(node)
        ros.start(type(node), VALUES)
        go_to(goal, within=0.05)  # the shoulder is weak
    ros.assert_limits_kept()


def test_a_robot_that_pauses_or_ends_well_is_not_taken_for_silent():
    (patience,) = (
        row.default
        for row in parameter_table(ControllerConfiguration)
        if row.name == "bounds_timeout"
    )
    # A pause begins just after a look at the time at worst.
    assert QUIET * patience > 2.0 * RETRY_PERIOD
    # Of programs that are ended at the same time the controller may see the signal last.
    assert QUIET * patience > SIGNAL_CHECK_PERIOD
