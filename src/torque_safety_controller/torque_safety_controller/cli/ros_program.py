# SPDX-License-Identifier: Apache-2.0
"""Entry points of the package's programs, which import nothing heavy themselves."""

from __future__ import annotations

from functools import partial

from viability_bounds_pkg.cli.ros_program import run_program

_CONTROL_MSGS = {"control_msgs": "apt install ros-jazzy-control-msgs"}

controller_node = partial(run_program, "torque_safety_controller.node.controller_node")
fit_capsules = partial(run_program, "torque_safety_controller.tools.fit_capsules")
gain_limits = partial(run_program, "torque_safety_controller.tools.gain_limits")
identify_friction = partial(run_program, "torque_safety_controller.tools.identify_friction")
moveit_node = partial(run_program, "torque_safety_controller.remote.moveit_node", _CONTROL_MSGS)
new_robot = partial(run_program, "torque_safety_controller.tools.new_robot")
safety_stack = partial(run_program, "torque_safety_controller.node.safety_stack")
teleop = partial(run_program, "torque_safety_controller.remote.teleop")
