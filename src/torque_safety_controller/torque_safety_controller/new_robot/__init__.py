# SPDX-License-Identifier: Apache-2.0
"""Parameters of a new robot, found from its URDF: joints, limits, postures, margins."""

from torque_safety_controller.new_robot.chain import Chain, NewRobotError, find_chain
from torque_safety_controller.new_robot.estimates import Estimates, estimate
from torque_safety_controller.new_robot.files import imperfect_file, parameter_file, scenario_file
from torque_safety_controller.new_robot.postures import SelfCollisions, find_postures

__all__ = [
    "Chain",
    "Estimates",
    "NewRobotError",
    "SelfCollisions",
    "estimate",
    "find_chain",
    "find_postures",
    "imperfect_file",
    "parameter_file",
    "scenario_file",
]
