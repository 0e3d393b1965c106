# SPDX-License-Identifier: Apache-2.0
"""What the controller takes from the parameters of the bounds node beside it."""

from types import SimpleNamespace

import pytest
from rclpy.context import Context

from torque_safety_controller.node.declared import (
    commands_in_flight,
    covered_misses,
    declared_robot,
)
from viability_bounds_pkg.ros.given_parameters import remember_arguments
from viability_bounds_pkg.testing.ros_harness import config_folder


def declared(*words):
    """Return what a node reads of the bounds node beside it, from its own command line."""
    context = Context()
    remember_arguments(context, ["--ros-args", *words])
    return declared_robot(SimpleNamespace(context=context, get_namespace=lambda: "/left"))


@pytest.mark.parametrize(
    ("given", "row", "way"),
    [
        ((), 1, 4),
        (("delay:=2", "missed_deadlines:=4"), 4, 9),
        (("delay:=2", "delay_jitter:=3", "missed_deadlines:=4"), 4, 12),
        (("bounds_node:delay:=1",), 1, 5),
        (("controller_node:delay:=1",), 1, 4),
    ],
)
def test_late_and_missed_commands_are_within_reach(given, row, way):
    rules = [word for rule in given for word in ("-p", rule)]
    robot = declared("--params-file", str(config_folder() / "panda.yaml"), *rules)
    assert (covered_misses(robot), commands_in_flight(robot)) == (row, way)


def test_without_a_file_little_is_declared():
    assert declared() is None
    assert (covered_misses(None), commands_in_flight(None)) == (1, 4)
