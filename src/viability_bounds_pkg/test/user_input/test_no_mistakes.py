# SPDX-License-Identifier: Apache-2.0
"""What is unusual, but no mistake: it must not be refused.

test/project/test_mistakes.py has the rest.
"""

import math

import pytest

from viability_bounds_pkg.exceptions import did_you_mean
from viability_bounds_pkg.ros.given_parameters import foreign_sections
from viability_bounds_pkg.ros.ros_arguments import check_ros_arguments
from viability_bounds_pkg.user_input.known_names import unknown_parameters
from viability_bounds_pkg.user_input.parameter_files import check_parameter_files
from viability_bounds_pkg.user_input.urdf_check import check_with_urdf
from viability_bounds_pkg.user_input.yaml_file import YamlError, load_yaml


@pytest.mark.parametrize(
    "text",
    [
        "/**/controller_node2:\n  ros__parameters: {pose_kp: 1.0}\n",
        "/**/left_controller_node:\n  ros__parameters: {pose_kp: 1.0}\n",
        "/left/bounds_node:\n  ros__parameters: {rate_hz: 1}\n"
        "/right/bounds_node:\n  ros__parameters: {rate_hz: 1}\n",
        "left:\n  bounds_node:\n    ros__parameters: {rate_hz: 1}\n",
        "robot_state_publisher:\n  ros__parameters: {publish_frequency: 50.0}\n",
        "/**:\n  ros__parameters: {}\n",
        "/**:\n  ros__parameters: {group: {inner: [1, 2]}, names: [a, b], none: null}\n",
        "/**:\n  ros__parameters: {robot_name: one}\n/**/bounds_node:\n"
        "  ros__parameters: {robot_name: one}\n",
    ],
)
def test_parameter_files_that_are_used(tmp_path, text):
    path = tmp_path / "robot.yaml"
    path.write_text(text)
    check_parameter_files([str(path)])


@pytest.mark.parametrize(
    "words",
    [
        "-p a:=1 -p node:b:='' -p c:=[1.0,2.0] -p d:=package://a/b",
        "-r __ns:=/left -r __node:=left_bounds -r joint_states:=/left/joint_states",
        "-r bounds_node:joint_states:=other -r /tf:=tf -r ~/reset:=again -r scan:=front/scan",
        "--log-level debug --log-level bounds_node:=WARN --disable-external-lib-logs",
        "-p a:=1 -- -p b=1 --params-file",
    ],
)
def test_arguments_that_are_used(words):
    check_ros_arguments(["program", "--other", "--ros-args", *words.split()], {})


@pytest.mark.parametrize("domain", ["", "0", "232"])
def test_domains_that_are_used(domain):
    check_ros_arguments([], {"ROS_DOMAIN_ID": domain})


def test_a_file_for_two_arms_is_for_both(tmp_path):
    path = tmp_path / "robot.yaml"
    path.write_text(
        "/left/bounds_node:\n  ros__parameters: {a: 1}\n"
        "/right/bounds_node:\n  ros__parameters: {a: 1}\n"
    )
    words = ["--ros-args", "--params-file", str(path)]
    assert foreign_sections(words, "/left/bounds_node") == []
    assert foreign_sections(words, "/other/bounds_node") == [
        "/left/bounds_node",
        "/right/bounds_node",
    ]


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
    assert unknown_parameters(["rate_hz", "use_sim_time", "own"], ["own"]) == ""
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
