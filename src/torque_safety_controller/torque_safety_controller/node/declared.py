# SPDX-License-Identifier: Apache-2.0
"""What is declared of the robot for the bounds node, which is in the same parameter files."""

from __future__ import annotations

from rclpy.node import Node

from viability_bounds_pkg.exceptions import ArmSafetyError
from viability_bounds_pkg.node.bounds_parameters import BoundsConfiguration
from viability_bounds_pkg.parameter import read
from viability_bounds_pkg.parameter_files import given_parameters

UNDECLARED = 1
"""Missed periods that the bounds cover by their defaults."""


def declared_robot(node: Node) -> BoundsConfiguration | None:
    """Return the parameters that the bounds node beside a node gets; None if it cannot start."""
    beside = f"{node.get_namespace().rstrip('/')}/bounds_node"
    try:
        return read(BoundsConfiguration, given_parameters(node.context, beside))
    except ArmSafetyError:  # the node that they are for says so
        return None


def limits_jerk(robot: BoundsConfiguration | None) -> bool:
    """Return whether the bounds are for a limited jerk, and need the accelerations commanded."""
    return robot is not None and len(robot.jerk_max) > 0


def commands_in_flight(robot: BoundsConfiguration | None) -> int:
    """Return how many of the last commands may act at a state, by what is declared.

    Late ones and missed periods count; two are added for what nobody declares.
    """
    late = 0 if robot is None else robot.declared.delay + robot.declared.delay_jitter
    return 3 + late + covered_misses(robot)


def covered_misses(robot: BoundsConfiguration | None) -> int:
    """Return how many missed periods in a row the bounds cover."""
    if robot is None:
        return UNDECLARED
    return robot.declared.missed_deadlines or round(robot.horizon / robot.dt) - 1
