# SPDX-License-Identifier: Apache-2.0
"""Parameter files and command lines: the last value counts, whatever its type and section."""

import math

import pytest
from rclpy.parameter import Parameter

from viability_bounds_pkg.node.bounds_node import BoundsNode
from viability_bounds_pkg.parameter_files import (
    ParameterFileError,
    YamlError,
    given_parameters,
    is_section_of,
    load_yaml,
    node_parameters,
    read_sections,
    remember_arguments,
)


@pytest.mark.parametrize(
    ("section", "node", "covers"),
    [
        ("/**", "/left/arm/bounds_node", True),
        ("/**/bounds_node", "/bounds_node", True),
        ("/**/bounds_node", "/left/bounds_node", True),
        ("bounds_node", "/left/bounds_node", False),
        ("/*/bounds_node", "/left/bounds_node", True),
        ("/*/bounds_node", "/bounds_node", False),
        ("/left/bounds_node", "/right/bounds_node", False),
        ("/**/b.unds_node", "/bounds_node", False),
    ],
)
def test_which_nodes_a_section_is_for(section, node, covers):
    assert is_section_of(section, node) == covers


def test_sections_may_be_nested_and_of_nodes_with_other_names(tmp_path):
    path = tmp_path / "robot.yaml"
    path.write_text(
        "/**/left_controller_node:\n  ros__parameters: {a: 1}\n"
        "left:\n  bounds_node:\n    ros__parameters: {a: 1}\n"
        "robot_state_publisher:\n  ros__parameters: {a: 50.0}\n"
    )
    sections = ["/**/left_controller_node", "/left/bounds_node", "/robot_state_publisher"]
    assert list(read_sections(path)) == sections


def test_tools_take_the_last_value_of_several_files(tmp_path):
    first, second = tmp_path / "robot.yaml", tmp_path / "overlay.yaml"
    first.write_text(
        "/**:\n  ros__parameters: {rate_hz: 500.0, torque_max: [1.0]}\n"
        "/**/bounds_node:\n  ros__parameters: {method: exact}\n"
        "/**/controller_node:\n  ros__parameters: {pose_kp: 4.0}\n"
    )
    second.write_text("bounds_node:\n  ros__parameters: {method: naive}\n")
    values = {"rate_hz": 500.0, "torque_max": [1.0], "method": "naive"}
    assert node_parameters([first, second], "/**/bounds_node") == values
    with pytest.raises(ParameterFileError, match=r"no parameters under '/\*\*' or"):
        node_parameters([second], "/**/controller_node")


def test_nodes_take_what_is_given_last_in_files_and_on_the_command_line(ros, tmp_path):
    file = tmp_path / "robot.yaml"
    file.write_text(
        "/**:\n  ros__parameters: {rate_hz: 500, only: 1}\n"
        "/**/bounds_node:\n  ros__parameters: {method: exact}\n"
        "/**/controller_node:\n  ros__parameters: {other: 4}\n"
    )
    rules = "rate_hz:=250.0", "method:=naive", "controller_node:method:=no", "bounds_node:own:=1"
    words = [word for rule in rules for word in ("-p", rule)]
    last = ["--params-file", str(file)]
    remember_arguments(ros.context, ["--ros-args", *last, *words])
    values = {"rate_hz": 250.0, "only": 1, "method": "naive", "own": 1}
    assert given_parameters(ros.context, "/left/bounds_node") == values
    remember_arguments(ros.context, ["--ros-args", *words, *last])
    assert given_parameters(ros.context, "/bounds_node")["method"] == "exact"


def test_a_node_starts_with_what_was_given_and_forgets_null(ros):
    """As after ``ros2 param dump``."""
    rules = "rate_hz:=250.0", "locked_joints:=null", "torque_max:=null"
    words = [word for rule in rules for word in ("-p", rule)]
    remember_arguments(ros.context, ["--ros-args", *words])
    # What rcl makes of it: null is a string, and a whole number in a file wins.
    of_rcl = {"rate_hz": 500, "locked_joints": "null", "torque_max": "null"}
    plain = {"joints": ["one"], "position_min": [-1.0], "position_max": [1.0]}
    plain |= {"velocity_max": [1.0], "acceleration_min": [-5.0], "acceleration_max": [5.0]}
    node = ros.start(BoundsNode, plain | of_rcl)
    assert node.get_parameter("rate_hz").value == 250.0
    assert node.get_parameter("locked_joints").type_ == Parameter.Type.NOT_SET


def test_a_name_that_yaml_takes_for_something_else_is_unknown(tmp_path):
    path = tmp_path / "a.yaml"
    path.write_text("/**: {ros__parameters: {1: 2, off: 3}}")
    with pytest.raises(ParameterFileError, match="'1'.*'False'"):
        node_parameters([path], "bounds_node")


def test_yaml_is_read_as_rcl_reads_it():
    text = "{a: 1e-3, b: -.5, c: .inf, d: [1, 2], e: null, f: '1', g: true, h: package://a/b}"
    values = {"a": 1e-3, "b": -0.5, "c": math.inf, "d": [1, 2], "e": None, "f": "1", "g": True}
    assert load_yaml(text) == values | {"h": "package://a/b"}
    with pytest.raises(YamlError, match=r"^f, line 1: 'a' a second time"):
        load_yaml("{a: 1, a: 1}", "f")
