# SPDX-License-Identifier: Apache-2.0
"""Values from files and the command line: the last one counts, and nothing is ignored."""

import math

import pytest
from rclpy.parameter import Parameter

from viability_bounds_pkg.node.bounds_node import BoundsNode
from viability_bounds_pkg.node.bounds_parameters import BoundsConfiguration
from viability_bounds_pkg.parameter import parameter_table
from viability_bounds_pkg.ros.claim import TakenError
from viability_bounds_pkg.ros.given_parameters import (
    UnknownParameterError,
    given_parameters,
    is_section_of,
    note_arguments,
    refuse_renamed,
    why_missing,
)
from viability_bounds_pkg.user_input.known_names import unknown_parameters

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


@pytest.mark.parametrize(
    ("section", "node", "covers"),
    [
        ("/**", "/bounds_node", True),
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
        "/**/bounds_node:\n  ros__parameters: {method: exact, group: {inner: 2}}\n"
        "left:\n  bounds_node:\n    ros__parameters: {deep: 3}\n"
        "/**/controller_node:\n  ros__parameters: {other: 4}\n"
    )
    rules = (
        "rate_hz:=250.0",
        "method:=naive",
        "controller_node:method:=no",
        "bounds_node:own:=1e-3",
    )
    given = given_parameters(arguments(*rules, file=file), "/left/bounds_node")
    assert given == {
        "rate_hz": 250.0,
        "only": 1,
        "method": "naive",
        "group.inner": 2,
        "deep": 3,
        "own": 1e-3,
    }
    assert isinstance(given["rate_hz"], float)
    later = [*arguments(*rules), *arguments(file=file)]
    assert given_parameters(later, "/bounds_node")["method"] == "exact"


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
    given = given_parameters(arguments(f"name:={text}"), "/node")["name"]
    assert given == value
    assert type(given) is type(value)


def test_what_is_not_for_ros_or_cannot_be_read_gives_nothing(tmp_path):
    (tmp_path / "bad.yaml").write_text("{")
    words = ["-p", "a:=1", *arguments("no rule", file=tmp_path / "bad.yaml"), "--", "-p", "b:=2"]
    assert given_parameters(words, "/node") == {}
    assert given_parameters(arguments(file=tmp_path / "missing.yaml"), "/node") == {}


def test_unknown_names_are_refused_with_the_nearest_known_one():
    names = ["own", "disturbance_time", "use_sim_time", "qos_overrides./a.b"]
    assert unknown_parameters(names, ["own"]) == ""
    assert unknown_parameters(["distrubance_time", "zzz"], ["own"]) == (
        "unknown parameter 'distrubance_time'; did you mean 'disturbance_time'?; "
        "unknown parameter 'zzz'"
    )


def test_files_that_speak_of_the_node_by_another_name_are_refused(tmp_path):
    file = tmp_path / "robot.yaml"
    file.write_text(
        "/**:\n  ros__parameters: {a: 1}\n/**/bounds_node:\n  ros__parameters: {b: 1}\n"
    )
    words = arguments(file=file)
    refuse_renamed(words, "/left/bounds_node", "bounds_node")
    with pytest.raises(UnknownParameterError, match=r"name the section '/\*\*/other'"):
        refuse_renamed(words, "/other", "bounds_node")
    file.write_text(file.read_text() + "/**/other:\n  ros__parameters: {b: 1}\n")
    refuse_renamed(words, "/other", "bounds_node")


def test_why_a_required_value_is_missing(tmp_path):
    assert "no parameter file" in why_missing(arguments("a:=1"), "/bounds_node")
    file = tmp_path / "robot.yaml"
    file.write_text("/**/bonds_node:\n  ros__parameters: {a: 1}\n")
    text = why_missing(arguments(file=file), "/bounds_node")
    assert text.endswith("no section '/**/bounds_node', only /**/bonds_node")
    file.write_text("/**/bounds_node:\n  ros__parameters: {a: 1}\n")
    assert why_missing(arguments(file=file), "/bounds_node") == ""


def test_a_node_takes_the_values_given_last_and_forgets_null(ros, tmp_path):
    """As after ``ros2 param dump``: whole numbers for floats, null for what was left out."""
    file = tmp_path / "robot.yaml"
    file.write_text(
        "/**:\n  ros__parameters: {rate_hz: 500, locked_joints: null, torque_max: null}\n"
        "/**/bounds_node:\n  ros__parameters: {method: exact}\n"
    )
    note_arguments(ros.context, arguments("rate_hz:=250.0", "method:=naive", file=file))
    # What rcl makes of them: the integer stays, the section of the node wins, null is a string.
    node = ros.start(
        BoundsNode,
        PLAIN | {"rate_hz": 500, "method": "exact", "locked_joints": "null", "torque_max": "null"},
    )
    assert isinstance(node.get_parameter("rate_hz").value, float)
    assert node.get_parameter("rate_hz").value == 250.0
    assert node.get_parameter("method").value == "naive"
    assert node.get_parameter("locked_joints").type_ == Parameter.Type.NOT_SET


def test_a_node_does_not_start_with_a_misspelt_parameter(ros):
    with pytest.raises(UnknownParameterError, match="did you mean 'velocity_max'"):
        ros.start(BoundsNode, PLAIN | {"rate_hz": 500.0, "velocity_mx": [1.0]})
    ros.start(BoundsNode, PLAIN | {"rate_hz": 500.0, "pose_kp": 1.0})  # the controller's


def test_a_second_publisher_of_the_limits_does_not_start(ros):
    values = PLAIN | {"rate_hz": 500.0}
    first = ros.start(BoundsNode, values)
    with pytest.raises(TakenError, match=r"publishes '/acceleration_limits' in ROS domain"):
        ros.start(BoundsNode, values)
    ros.stop(first)
    ros.start(BoundsNode, values)


def test_the_parameters_of_a_node_are_among_the_known_names():
    assert unknown_parameters(row.name for row in parameter_table(BoundsConfiguration)) == ""
