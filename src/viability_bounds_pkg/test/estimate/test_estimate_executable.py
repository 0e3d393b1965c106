# SPDX-License-Identifier: Apache-2.0
"""The estimate_acceleration_limits executable, as a user starts it."""

import re
from functools import partial

import numpy as np
import pytest
import yaml

from viability_bounds_pkg.cli import limits_file
from viability_bounds_pkg.cli.estimate_acceleration_limits import main
from viability_bounds_pkg.exceptions import SettingError
from viability_bounds_pkg.node.bounds_parameters import BoundsConfiguration
from viability_bounds_pkg.parameter_files import read_files
from viability_bounds_pkg.robot.configuration import check_with_urdf
from viability_bounds_pkg.testing.executables import called, started
from viability_bounds_pkg.testing.ros_harness import config_folder
from viability_bounds_pkg.testing.two_joint_robot import LIMIT, ROBOT, parameters_in

MODULE = "viability_bounds_pkg.cli.estimate_acceleration_limits"
# The shoulder with the arm stretched out to the side.
INERTIA, WEIGHT = 2.0 * 0.25 + 0.5 * 0.36, 9.81 * (2.0 * 0.5 + 0.5 * 0.6)


@pytest.fixture
def call(capfd):
    """Runs the tool in this process, which saves the start of an interpreter."""
    return partial(called, capfd, main)


def printed(ended):
    """The parameters on standard output, where they go without -o."""
    assert (ended.returncode, ended.stderr) == (0, "")
    return parameters_in(ended.stdout[ended.stdout.index("/**/bounds_node:") :])


def one_line(ended, code=1):
    assert ended.returncode == code, ended.stderr
    assert ended.stderr.count("\n") == 1, ended.stderr
    assert "Traceback" not in ended.stderr
    return ended.stderr


def test_limits_are_written_as_an_overlay(write_robot, call, tmp_path):
    path, output = write_robot(), tmp_path / "limits.yaml"
    before = path.read_bytes()
    ended = call(path, "-o", output, "--samples", 1000, "--seed", 2)
    assert (ended.returncode, ended.stderr) == (0, "")
    assert path.read_bytes() == before
    written = parameters_in(output.read_text())
    assert set(written) == {"joints", "acceleration_min", "acceleration_max"}
    assert written["joints"] == ["shoulder", "wrist"]
    controller = yaml.safe_load(output.read_text())["/**/controller_node"]
    assert controller["ros__parameters"] == written
    at_rest = (30.0 - WEIGHT) / INERTIA
    assert 0.6 * at_rest < written["acceleration_max"][0] <= 1.01 * at_rest
    for word in ("shoulder: torque leaves", "worst a_min at q = [", "evaluations"):
        assert word in ended.stdout


def test_limits_are_refused_after_the_file_of_another_robot(tmp_path):
    written, folder = tmp_path / "limits.yaml", config_folder()
    joints = [f"left_{k}" for k in range(7)]
    written.write_text(limits_file.overlay(joints, {"acceleration_min": -np.ones(7)}, []))
    for path in (written, folder / "imperfect" / "baxter_left_arm.yaml"):
        config = read_files(BoundsConfiguration, [folder / "panda.yaml", path], limits_file.NODE)
        with pytest.raises(SettingError, match="'left_s?0'; allowed: joints of the URDF"):
            check_with_urdf(config, config.read_urdf())


def test_options_reach_the_limits(write_robot, call):
    path = write_robot()
    plain = printed(call(path, "--samples", 300))
    options = "--torque-reserve 0.2 --override wrist=-3,2.5 --cap 5 --drift --method sampling"
    options += " --torque-rate 900,800"
    ended = call(path, "--samples", 300, *options.split())
    changed = printed(ended)
    assert plain["acceleration_max"][0] > 5.0
    assert changed["acceleration_min"] == [-5.0, -3.0]
    assert changed["acceleration_max"] == [5.0, 2.5]
    assert len(changed["acceleration_drift"]) == 2 and min(changed["acceleration_drift"]) > 0.0
    assert len(changed["jerk_max"]) == 2 and min(changed["jerk_max"]) > 0.0
    assert "shoulder: a in [-5, 5] rad/s^2 (capped)" in ended.stdout
    for rate, line in (
        ("1,2,3", "--torque-rate must be one number, or 2"),
        ("1e-6", "torque rate of 1e-06 N m/s is too small to keep accelerations"),
    ):
        assert line in one_line(call(path, "--samples", 300, "--cap", 5, "--torque-rate", rate))


def test_reserve_takes_its_part_of_the_torque(write_robot, call):
    path = write_robot(parameters="    torque_max: [30.0, 30.0]")
    reserved = printed(call(path, "--samples", 100, "--torque-reserve", 0.5))
    path = write_robot(parameters="    torque_max: [15.0, 15.0]")
    assert printed(call(path, "--samples", 100)) == reserved


def test_limits_of_the_parameter_file_beat_those_of_the_urdf(write_robot, call):
    path = write_robot(
        limit="",
        type="continuous",
        parameters="    velocity_max: [1, 1]\n    torque_max: [50.0, 30.0]\n",
    )
    limits = printed(call(path, "--samples", 1000))
    at_rest = (50.0 - WEIGHT) / INERTIA
    assert limits["acceleration_max"][0] == pytest.approx(at_rest, rel=0.05)
    # All the way round, it meets gravity at its worst on both sides.
    assert limits["acceleration_min"][0] == pytest.approx(-at_rest, rel=0.05)


def test_gravity_beyond_the_torque(write_robot, call, tmp_path):
    output = tmp_path / "limits.yaml"
    path = write_robot(parameters="    torque_max: [5.0, 30.0]")
    line = one_line(call(path, "--samples", 300, "-o", output))
    assert "joint shoulder" in line and "5 N m" in line
    assert "lower velocities do not help" in line
    holds = float(re.search(r"joint shoulder takes (.*) N m just to hold still", line)[1])
    assert 5.0 < holds <= 1.001 * WEIGHT
    assert not output.exists()
    ended = call(path, "--samples", 300, "--override", "shoulder=-1,1")
    assert printed(ended)["acceleration_max"][0] == 1.0
    assert "override, NOT available in" in ended.stdout


def test_limits_of_most_states_where_there_are_none_for_all(write_robot, call):
    path = write_robot(parameters="    torque_max: [10.0, 30.0]")
    assert "safety_filter (--share)" in one_line(call(path, "--samples", 300))
    ended = call(path, "--samples", 300, "--share", 0.4)
    assert printed(ended)["acceleration_max"][0] > 0.0
    assert "override, NOT available in 60 % of random states" in ended.stdout


def test_slides_have_units_of_their_own(write_robot, call):
    ended = call(write_robot(type="prismatic"), "--samples", 300, "--cap", 5, "--drift")
    assert re.search(r"shoulder: torque leaves \[.*\] m/s\^2", ended.stdout)
    assert "shoulder: a in [-5, 5] m/s^2 (capped)" in ended.stdout
    assert "# rad/s^2, m/s^2 of slides, drift in rad/s^3, m/s^3 of slides" in ended.stdout


def test_too_much_speed_for_the_torque(write_robot, call):
    """Joint, state, lower velocities and the override: all that is offered helps."""
    fast = "    velocity_max: [40.0, 40.0]\n    torque_max: [30.0, 10.0]"
    line = one_line(call(write_robot(parameters=fast), "--samples", 2000))
    assert re.search(r"joint (shoulder|wrist): its torque of .* at q = \[.*\], v = \[.*\]", line)
    scale = float(re.search(r"scaled by ([\d.]+)", line)[1])
    lower = [float(x) for x in re.search(r"to \[([^]]*)\] rad/s", line)[1].split(",")]
    assert lower == pytest.approx([40.0 * scale, 40.0 * scale], rel=0.01)
    slower = fast.replace("[40.0, 40.0]", str(lower))
    found = printed(call(write_robot(parameters=slower), "--samples", 2000))
    smallest = min(*found["acceleration_max"], *(-a for a in found["acceleration_min"]))
    assert 0.5 < smallest < 1.5


@pytest.mark.parametrize(
    ("case", "message"),
    [
        ({"limit": "", "type": "continuous"}, "the URDF has no velocity limit of shoulder"),
        ({"limit": ""}, "'position_min' is not set; allowed: given, as the URDF has no lower"),
        ({"limit": LIMIT.replace("30", "0")}, "parameter 'torque_max' is not set"),
        ({"hand_mass": 0.0}, "joint wrist moves no inertia"),
        ({"parameters": "    velocity_max: [1.0]"}, "'velocity_max' is [1]; allowed: 2 numbers"),
        ({"parameters": "    velocity_max: [1, fast]"}, "allowed: a list of numbers"),
        ({"parameters": "    velocity_max: [1, 0]"}, "allowed: finite numbers > 0"),
        ({"parameters": "    position_min: [9, 0]"}, "'position_max' is [2, 2]; allowed: above"),
        ({"text": "/**:\n  ros__parameters:\n    joints: [shoulder]\n"}, "'robot_description'"),
        ({"text": ROBOT.replace("wrist", "elbow")}, "parameter 'joints' is 'elbow'"),
        ({"text": ROBOT.replace("{urdf}", "/no/such.urdf")}, "/no/such.urdf: no such file"),
        ({"text": "/**: 1\n"}, "'/**' is not below 'ros__parameters'"),
        ({"text": "[1, 2\n"}, "robot.yaml, line 2: "),
        ({"text": ""}, "no parameters"),
    ],
)
def test_bad_robots_are_told_in_one_line(write_robot, call, case, message):
    assert message in one_line(call(write_robot(**case), "--samples", 100))


@pytest.mark.parametrize(
    ("option", "value", "message"),
    [
        ("--samples", "0", "must be at least 1, is 0"),
        ("--samples", "inf", "must be at least 1, is inf"),
        ("--torque-reserve", "1", "must be at least 0 and less than 1"),
        ("--override", "wrist", "must read JOINT=MIN,MAX"),
        ("--cap", "-2", "must be positive"),
    ],
)
def test_bad_usage_is_told_in_one_line(write_robot, call, option, value, message):
    assert f"{option}: {message}" in one_line(call(write_robot(), option, value), code=2)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--override", "elbow=-1,1"], "override of unknown joint 'elbow'"),
        (["-o", "{tmp}"], "is a directory"),
        (["-o", "{tmp}/none/limits.yaml"], "no directory"),
        (["-o", "{tmp}/robot.yaml"], "is the robot's parameter file"),
        # Where nobody may create a file, root included.
        (["-o", "/proc/limits.yaml"], "/proc cannot be written to"),
    ],
)
def test_options_that_do_not_fit_are_told_in_one_line(
    write_robot, call, tmp_path, arguments, message
):
    path = write_robot()
    before = path.read_text()
    arguments = [argument.replace("{tmp}", str(tmp_path)) for argument in arguments]
    assert message in one_line(call(path, "--samples", 100, *arguments))
    assert path.read_text() == before


def test_missing_parameter_file(tmp_path):
    """In a process of its own, as proof that the exit code gets out."""
    assert "none.yaml" in one_line(started("-m", MODULE, tmp_path / "none.yaml"))


def test_what_was_found_is_printed_when_it_cannot_be_written(
    write_robot, call, tmp_path, monkeypatch
):
    def full(*arguments):
        raise OSError("no space left on device")

    monkeypatch.setattr(limits_file.os, "fsync", full)
    ended = call(write_robot(), "--samples", 100, "-o", tmp_path / "limits.yaml")
    assert "no space left" in one_line(ended)
    found = parameters_in(ended.stdout[ended.stdout.index("/**/bounds_node:") :])
    assert set(found) == {"joints", "acceleration_min", "acceleration_max"}
