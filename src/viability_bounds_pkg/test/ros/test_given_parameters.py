# SPDX-License-Identifier: Apache-2.0
"""Values from files and the command line: the last one counts, and nothing is ignored."""

import math

import pytest
from rclpy.context import Context
from rclpy.parameter import Parameter

from viability_bounds_pkg.node.bounds_node import BoundsNode
from viability_bounds_pkg.parameter_files import is_section_of
from viability_bounds_pkg.ros.given_parameters import given_parameters, remember_arguments

PLAIN = {
    "joints": ["one"],
    "position_min": [-1.0],
    "position_max": [1.0],
    "velocity_max": [1.0],
    "acceleration_min": [-5.0],
    "acceleration_max": [5.0],
}


def arguments(*rules, file=None):
    """Of a command line: a parameter file, then ``-p`` rules."""
    words = ["--ros-args"]
    if file is not None:
        words += ["--params-file", str(file)]
    return words + [word for rule in rules for word in ("-p", rule)]


def given(node, words):
    context = Context()
    remember_arguments(context, words)
    return given_parameters(context, node)


@pytest.mark.parametrize(
    ("section", "node", "covers"),
    [
        ("/**", "/left/arm/bounds_node", True),
        ("/**/bounds_node", "/bounds_node", True),
        ("/**/bounds_node", "/left/bounds_node", True),
        ("bounds_node", "/bounds_node", True),
        ("bounds_node", "/left/bounds_node", False),
        ("/*/bounds_node", "/left/bounds_node", True),
        ("/*/bounds_node", "/bounds_node", False),
        ("/left/*", "/left/bounds_node", True),
        ("/left/bounds_node", "/right/bounds_node", False),
        ("/**/bounds", "/bounds_node", False),
        ("/**/b.unds_node", "/bounds_node", False),
    ],
)
def test_which_nodes_a_section_is_for(section, node, covers):
    assert is_section_of(section, node) == covers


def test_the_last_value_counts_whatever_its_type_and_section(tmp_path):
    file = tmp_path / "robot.yaml"
    file.write_text(
        "/**:\n  ros__parameters: {rate_hz: 500, only: 1}\n"
        "/**/bounds_node:\n  ros__parameters: {method: exact}\n"
        "left:\n  bounds_node:\n    ros__parameters: {deep: 3}\n"
        "/**/controller_node:\n  ros__parameters: {other: 4}\n"
    )
    rules = (
        "rate_hz:=250.0",
        "method:=naive",
        "controller_node:method:=no",
        "bounds_node:own:=1e-3",
    )
    values = given("/left/bounds_node", arguments(*rules, file=file))
    assert values == {"rate_hz": 250.0, "only": 1, "method": "naive", "deep": 3, "own": 1e-3}
    assert isinstance(values["rate_hz"], float)
    later = [*arguments(*rules), *arguments(file=file)]
    assert given("/bounds_node", later)["method"] == "exact"


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1", 1),
        ("1e3", 1000.0),
        ("-.5", -0.5),
        (".inf", math.inf),
        ("'1'", "1"),
        ("true", True),
        ("null", None),
        ("[]", []),
        ("[1, 2]", [1, 2]),
        ("exact", "exact"),
        ("package://a/b.urdf", "package://a/b.urdf"),
    ],
)
def test_how_values_are_read(text, value):
    found = given("/node", arguments(f"name:={text}"))["name"]
    assert found == value
    assert type(found) is type(value)


def test_a_node_takes_the_values_given_last_and_forgets_null(ros, tmp_path):
    """As after ``ros2 param dump``: whole numbers for floats, null for what was left out."""
    file = tmp_path / "robot.yaml"
    file.write_text(
        "/**:\n  ros__parameters: {rate_hz: 500, locked_joints: null, torque_max: null}\n"
        "/**/bounds_node:\n  ros__parameters: {method: exact}\n"
    )
    remember_arguments(ros.context, arguments("rate_hz:=250.0", "method:=naive", file=file))
    # What rcl makes of them: the integer stays, the section of the node wins, null is a string.
    of_rcl = {"rate_hz": 500, "method": "exact", "locked_joints": "null", "torque_max": "null"}
    node = ros.start(BoundsNode, PLAIN | of_rcl)
    assert node.get_parameter("rate_hz").value == 250.0
    assert isinstance(node.get_parameter("rate_hz").value, float)
    assert node.get_parameter("method").value == "naive"
    assert node.get_parameter("locked_joints").type_ == Parameter.Type.NOT_SET
