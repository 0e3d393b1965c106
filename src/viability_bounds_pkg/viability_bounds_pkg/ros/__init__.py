# SPDX-License-Identifier: Apache-2.0
"""What every ROS node of the project shares: parameters, topics, messages, running."""

from viability_bounds_pkg.ros.messages import Arrival, Diagnostics, JointStateReader
from viability_bounds_pkg.ros.parameters import NodeParameters
from viability_bounds_pkg.ros.program import run, spin
from viability_bounds_pkg.ros.robot_urdf import robot_urdf
from viability_bounds_pkg.ros.runtime import make_executor
from viability_bounds_pkg.ros.topics import OfferedService, Topic

__all__ = [
    "Arrival",
    "Diagnostics",
    "JointStateReader",
    "NodeParameters",
    "OfferedService",
    "Topic",
    "make_executor",
    "robot_urdf",
    "run",
    "spin",
]
