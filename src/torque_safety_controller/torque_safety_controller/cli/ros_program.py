# SPDX-License-Identifier: Apache-2.0
"""Entry points of the package's programs, which import nothing heavy themselves."""

from __future__ import annotations

from viability_bounds_pkg.cli.ros_program import run_program, run_with_ros


def controller_node() -> int:
    """Run the controller node."""
    return run_with_ros("controller_node", "torque_safety_controller.node.controller_node")


def identify_friction() -> int:
    """Run the identification of joint friction."""
    return run_program("torque_safety_controller.cli.identify_friction")


def gain_limits() -> int:
    """Run the check of a robot's gains."""
    return run_program("torque_safety_controller.tools.gain_limits")


def moveit_node() -> int:
    """Run the node that takes what MoveIt sends."""
    libraries = {"control_msgs": "apt install ros-jazzy-control-msgs"}
    return run_with_ros("moveit_node", "torque_safety_controller.remote.moveit_node", libraries)


def new_robot() -> int:
    """Make the parameter files of an arm from its URDF."""
    return run_program("torque_safety_controller.tools.new_robot")


def safety_stack() -> int:
    """Run bounds, controller and estimator in one process."""
    return run_with_ros("safety_stack", "torque_safety_controller.node.safety_stack")


def teleop() -> int:
    """Run the keyboard teleoperation."""
    return run_with_ros("teleop", "torque_safety_controller.remote.teleop")
