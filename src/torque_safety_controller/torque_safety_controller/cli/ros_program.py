# SPDX-License-Identifier: Apache-2.0
"""Entry point of the controller node, which says in one line where ROS 2 is missing."""

from __future__ import annotations

from viability_bounds_pkg.cli.ros_program import run_with_ros


def controller_node() -> int:
    """Run the controller node."""
    return run_with_ros("controller_node", "torque_safety_controller.node.controller_node")
