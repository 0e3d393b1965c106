# SPDX-License-Identifier: Apache-2.0
"""Parameter files as tools read them, and what is unusual in them, but no mistake."""

import math
from pathlib import Path

import pytest

from viability_bounds_pkg.exceptions import did_you_mean
from viability_bounds_pkg.parameter_files import (
    ParameterFileError,
    YamlError,
    load_yaml,
    node_parameters,
    read_sections,
    unknown_parameters,
)
from viability_bounds_pkg.robot.configuration import check_with_urdf


@pytest.mark.parametrize(
    ("text", "sections"),
    [
        ("/**/controller_node2:\n  ros__parameters: {a: 1}\n", ["/**/controller_node2"]),
        ("/**/left_controller_node:\n  ros__parameters: {a: 1}\n", ["/**/left_controller_node"]),
        (
            "/left/bounds_node:\n  ros__parameters: {a: 1}\n"
            "/right/bounds_node:\n  ros__parameters: {a: 1}\n",
            ["/left/bounds_node", "/right/bounds_node"],
        ),
        ("left:\n  bounds_node:\n    ros__parameters: {a: 1}\n", ["/left/bounds_node"]),
        ("robot_state_publisher:\n  ros__parameters: {a: 50.0}\n", ["/robot_state_publisher"]),
        ("/**:\n  ros__parameters: {}\n", ["/**"]),
    ],
)
def test_sections_of_a_file(tmp_path, text, sections):
    path = tmp_path / "robot.yaml"
    path.write_text(text)
    assert list(read_sections(path)) == sections


def test_the_last_value_counts(tmp_path):
    first, second = tmp_path / "robot.yaml", tmp_path / "overlay.yaml"
    first.write_text(
        "/**:\n  ros__parameters: {rate_hz: 500.0, torque_max: [1.0]}\n"
        "/**/bounds_node:\n  ros__parameters: {method: exact}\n"
        "/**/controller_node:\n  ros__parameters: {pose_kp: 4.0}\n"
    )
    second.write_text("bounds_node:\n  ros__parameters: {method: naive}\n")
    assert node_parameters([first, second], "/**/bounds_node") == {
        "rate_hz": 500.0,
        "torque_max": [1.0],
        "method": "naive",
    }
    with pytest.raises(ParameterFileError, match=r"no parameters under '/\*\*' or"):
        node_parameters([second], "/**/controller_node")


def test_a_misspelt_parameter_is_refused_with_its_file(tmp_path):
    path = tmp_path / "robot.yaml"
    path.write_text("/**:\n  ros__parameters: {velocity_mx: [1.0]}\n")
    with pytest.raises(ParameterFileError) as refusal:
        node_parameters([path], "/**/bounds_node")
    assert str(refusal.value) == (
        f"{path}: unknown parameter 'velocity_mx'; did you mean 'velocity_max'?"
    )


def test_a_file_that_does_not_exist():
    with pytest.raises(YamlError, match="there is no such file"):
        read_sections(Path("missing.yaml"))


def test_yaml_as_rcl_reads_it():
    assert load_yaml("{a: 1e-3, b: -.5, c: .inf, d: [x], e: null}") == {
        "a": 1e-3,
        "b": -0.5,
        "c": math.inf,
        "d": ["x"],
        "e": None,
    }
    assert load_yaml("[{a: 1}, {a: 2}]") == [{"a": 1}, {"a": 2}]
    with pytest.raises(YamlError, match=r"^f, line 1: 'a' a second time"):
        load_yaml("{a: 1, a: 1}", "f")


def test_names():
    assert unknown_parameters(["rate_hz", "own"], ["own"]) == ""
    assert unknown_parameters(["distrubance_time", "zzz"]) == (
        "unknown parameter 'distrubance_time'; did you mean 'disturbance_time'?; "
        "unknown parameter 'zzz'"
    )
    assert did_you_mean("/Panda_Hand/", ["panda_hand", "other"]) == "; did you mean 'panda_hand'?"
    assert did_you_mean("zzz", ["panda_hand"]) == ""


def test_limits_and_joints_as_in_the_urdf_are_nothing_unusual():
    class Robot:
        joints = ("turn", "wheel")
        position_min, position_max = [-1.0, -math.inf], [1.0, math.inf]
        velocity_max, torque_max = [2.0, 99.0], [3.0, 99.0]

    urdf = (
        "<robot name='r'><joint name='turn' type='revolute'>"
        "<limit lower='-1' upper='1' velocity='2' effort='3'/></joint>"
        "<joint name='wheel' type='continuous'/>"
        "<transmission name='t'><joint name='turn'/></transmission></robot>"
    )
    assert check_with_urdf(Robot(), urdf) == []
    Robot.torque_max = [3.1, 99.0]
    (line,) = check_with_urdf(Robot(), urdf)
    assert line == "parameter 'torque_max' is 3.1 for turn, beyond the 3 of the URDF"
