# SPDX-License-Identifier: Apache-2.0
"""What every ROS node of the project shares: parameters, topics, messages, running."""

from viability_bounds_pkg.ros.messages import Diagnostics, JointStateReader, StampGuard, Verdict
from viability_bounds_pkg.ros.parameters import NodeParameters, Parameter, Range, read_values
from viability_bounds_pkg.ros.robot_parameters import (
    ROBOT_TABLE,
    RobotConfiguration,
    load_model,
    robot_configuration,
    robot_urdf,
)
from viability_bounds_pkg.ros.runtime import make_executor, run, spin
from viability_bounds_pkg.ros.topics import OfferedService, Topic

__all__ = [
    "ROBOT_TABLE",
    "Diagnostics",
    "JointStateReader",
    "NodeParameters",
    "OfferedService",
    "Parameter",
    "Range",
    "RobotConfiguration",
    "StampGuard",
    "Topic",
    "Verdict",
    "load_model",
    "make_executor",
    "read_values",
    "robot_configuration",
    "robot_urdf",
    "run",
    "spin",
]
