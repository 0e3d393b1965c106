# SPDX-License-Identifier: Apache-2.0
"""The estimate_acceleration_limits executable, started as a user starts it."""

from __future__ import annotations

import re
from functools import partial

import pytest
import yaml

from viability_bounds_pkg.cli import limits_file
from viability_bounds_pkg.cli.estimate_acceleration_limits import main
from viability_bounds_pkg.testing.executables import (
    called,
    started,
)
from viability_bounds_pkg.testing.two_joint_robot import LIMIT, ROBOT, parameters_in

MODULE = "viability_bounds_pkg.cli.estimate_acceleration_limits"


def printed(ended):
    """The parameters on standard output, where they go without -o."""
    return parameters_in(ended.stdout[ended.stdout.index("/**/bounds_node:") :])


@pytest.mark.parametrize("method", ["sampling", "refined"])
def test_limits_are_written_as_an_overlay(write_robot, tmp_path, method):
    path, output = write_robot(), tmp_path / "limits.yaml"
    before = path.read_bytes()
    ended = started(
        "-m", MODULE, path, "-o", output, "--samples", 3000, "--method", method, "--seed", 2
    )
    assert (ended.returncode, ended.stderr) == (0, "")
    assert path.read_bytes() == before
    written = parameters_in(output.read_text())
    assert set(written) == {"acceleration_min", "acceleration_max"}
    controller = yaml.safe_load(output.read_text())["/**/controller_node"]
    assert controller["ros__parameters"] == written
    # The shoulder with the arm stretched out to the side, at rest or nearly.
    inertia, weight = 2.0 * 0.25 + 0.5 * 0.36, 9.81 * (2.0 * 0.5 + 0.5 * 0.6)
    at_rest = (30.0 - weight) / inertia
    assert 0.6 * at_rest < written["acceleration_max"][0] <= 1.01 * at_rest
    for word in ("shoulder: torque leaves", "worst a_min at q = [", "evaluations"):
        assert word in ended.stdout


def test_same_seed_same_file(write_robot, call, tmp_path):
    path = write_robot()
    outputs = [tmp_path / name for name in ("first.yaml", "second.yaml", "third.yaml")]
    for output, seed in zip(outputs, (4, 4, 5), strict=True):
        assert call(path, "-o", output, "--samples", 50, "--seed", seed).returncode == 0
    texts = [output.read_text() for output in outputs]
    assert texts[0] == texts[1]
    assert parameters_in(texts[0]) != parameters_in(texts[2])


def test_options_reach_the_limits(write_robot, call):
    common = ("--samples", 500)
    path = write_robot()
    plain = printed(call(path, *common))
    ended = call(
        path,
        *common,
        *("--torque-reserve", 0.2),
        *("--override", "wrist=-3,2.5"),
        *("--cap", 5),
        "--drift",
    )
    assert (ended.returncode, ended.stderr) == (0, "")
    changed = printed(ended)
    assert plain["acceleration_max"][0] > 5.0
    assert changed["acceleration_min"] == [-5.0, -3.0]
    assert changed["acceleration_max"] == [5.0, 2.5]
    assert len(changed["acceleration_drift"]) == 2 and min(changed["acceleration_drift"]) > 0.0
    assert "shoulder: a in [-5, 5] rad/s^2 (capped)" in ended.stdout


def test_reserve_takes_its_part_of_the_torque(write_robot, call):
    path = write_robot(parameters="    torque_max: [30.0, 30.0]")
    reserved = call(path, "--samples", 300, "--torque-reserve", 0.5)
    halved = call(
        write_robot(parameters="    torque_max: [15.0, 15.0]"),
        "--samples",
        300,
        "--torque-reserve",
        0,
    )
    first, second = (printed(ended) for ended in (reserved, halved))
    assert first == second


def test_limits_of_the_parameter_file_beat_those_of_the_urdf(write_robot, call):
    path = write_robot(
        limit="",
        type="continuous",
        parameters="    velocity_max: [1, 1]\n    torque_max: [50.0, 30.0]\n",
    )
    ended = call(path, "--samples", 2000)
    assert (ended.returncode, ended.stderr) == (0, "")
    limits = printed(ended)
    inertia, weight = 2.0 * 0.25 + 0.5 * 0.36, 9.81 * (2.0 * 0.5 + 0.5 * 0.6)
    assert limits["acceleration_max"][0] == pytest.approx((50 - weight) / inertia, rel=0.05)


def test_locked_joints(write_robot, call):
    path = write_robot()
    lines = path.read_text().replace("joints: [shoulder, wrist]", "joints: [shoulder]")
    lines = lines.replace("acceleration_min: [-1.0, -1.0]", "acceleration_min: [-1.0]")
    found = []
    for angle in (0.0, 3.0):  # the hand stretched out, and folded back
        locked = f"joints: [shoulder]\n    locked_joints: [wrist]\n    locked_positions: [{angle}]"
        path.write_text(lines.replace("joints: [shoulder]", locked))
        ended = call(path, "--samples", 500)
        assert ended.returncode == 0, ended.stderr
        found.append(printed(ended))
    assert found[1]["acceleration_max"][0] > 1.1 * found[0]["acceleration_max"][0]


def one_line(ended, code=1):
    assert ended.returncode == code, ended.stderr
    assert ended.stderr.count("\n") == 1, ended.stderr
    assert "Traceback" not in ended.stderr
    return ended.stderr


@pytest.fixture
def call(capfd):
    """Runs the tool in this process, which saves the start of an interpreter."""
    return partial(called, capfd, main)


def test_gravity_beyond_the_torque(write_robot, call, tmp_path):
    output = tmp_path / "limits.yaml"
    path = write_robot(parameters="    torque_max: [5.0, 30.0]")
    line = one_line(call(path, "--samples", 500, "-o", output))
    assert "joint shoulder" in line and "5 N m" in line
    assert "lower velocities do not help" in line
    assert not output.exists()
    ended = call(path, "--samples", 500, "-o", output, "--override", "shoulder=-1,1")
    assert (ended.returncode, ended.stderr) == (0, "")
    assert "override, NOT available in" in ended.stdout
    assert parameters_in(output.read_text())["acceleration_max"][0] == 1.0


def test_limits_of_most_states_where_there_are_none_for_all(write_robot, call):
    path = write_robot(parameters="    torque_max: [10.0, 30.0]")
    alone = one_line(call(path, "--samples", 500))
    assert "safety_filter (--share)" in alone
    ended = call(path, "--samples", 500, "--share", 0.4)
    assert (ended.returncode, ended.stderr) == (0, "")
    assert "shoulder: a in [-" in ended.stdout
    assert "override, NOT available in 60 % of random states" in ended.stdout
    plenty = write_robot()
    assert (
        call(plenty, "--samples", 500, "--share", 0.4).stdout
        == call(plenty, "--samples", 500).stdout
    )


def test_too_much_speed_for_the_torque(write_robot, call, tmp_path):
    """Joint, state, lower velocities and the override: all that is offered helps."""
    output = tmp_path / "limits.yaml"
    fast = "    velocity_max: [40.0, 40.0]\n    torque_max: [30.0, 10.0]"
    line = one_line(call(write_robot(parameters=fast), "--samples", 3000, "-o", output))
    assert re.search(r"joint (shoulder|wrist): its torque of .* at q = \[.*\], v = \[.*\]", line)
    assert not output.exists()
    scale = float(re.search(r"scaled by ([\d.]+)", line)[1])
    lower = [float(x) for x in re.search(r"to \[([^]]*)\] rad/s", line)[1].split(",")]
    assert lower == pytest.approx([40.0 * scale, 40.0 * scale], rel=0.01)
    slower = fast.replace("[40.0, 40.0]", str(lower))
    ended = call(write_robot(parameters=slower), "--samples", 3000, "-o", output)
    assert (ended.returncode, ended.stderr) == (0, "")
    found = parameters_in(output.read_text())
    smallest = min(*found["acceleration_max"], *(-a for a in found["acceleration_min"]))
    assert 0.5 < smallest < 1.5
    joint = re.search(r"--override (\w+)=MIN,MAX", line)[1]
    both = [word for name in ("shoulder", "wrist") for word in ("--override", f"{name}=-1,1")]
    assert joint in ("shoulder", "wrist")
    assert call(write_robot(parameters=fast), "--samples", 100, *both).returncode == 0


def test_continuous_joint_with_limits_of_the_urdf(write_robot, call):
    path = write_robot(limit='<limit effort="30" velocity="4"/>', type="continuous")
    ended = call(path, "--samples", 2000)
    assert (ended.returncode, ended.stderr) == (0, "")
    inertia, weight = 2.0 * 0.25 + 0.5 * 0.36, 9.81 * (2.0 * 0.5 + 0.5 * 0.6)
    # All the way round, it meets gravity at its worst on both sides.
    limits = printed(ended)
    assert limits["acceleration_max"][0] <= 1.01 * (30.0 - weight) / inertia
    assert limits["acceleration_min"][0] == pytest.approx(-limits["acceleration_max"][0], rel=0.05)


def test_a_link_without_mass_that_carries_others_is_fine(write_robot, call):
    ended = call(write_robot(mass=0.0), "--samples", 300)
    assert (ended.returncode, ended.stderr) == (0, "")


@pytest.mark.parametrize(
    ("case", "message"),
    [
        ({"limit": "", "type": "continuous"}, "the URDF has no velocity limit of shoulder"),
        (
            {
                "limit": "",
                "type": "continuous",
                "parameters": "    velocity_max: [1.0, 1.0]",
            },
            "parameter 'torque_max' is not set; allowed: given, as the URDF has no effort limit",
        ),
        (
            {"limit": ""},
            "'position_min' is not set; allowed: given, as the URDF has no lower limit",
        ),
        (
            {"limit": '<limit lower="-1" upper="1" effort="30"/>'},
            "the URDF has no velocity limit of shoulder",
        ),
        ({"limit": LIMIT.replace("30", "0")}, "parameter 'torque_max' is not set"),
        ({"hand_mass": 0.0}, "joint wrist moves no inertia"),
        ({"hand_mass": 0.0, "mass": 0.0}, "joint shoulder moves no inertia"),
        ({"parameters": "    velocity_max: [1.0]"}, "'velocity_max' is [1]; allowed: 2 numbers"),
        ({"parameters": "    velocity_max: [1, fast]"}, "allowed: a list of numbers"),
        ({"parameters": "    velocity_max: [1, 0]"}, "allowed: finite numbers > 0"),
        ({"parameters": "    position_min: [9, 0]"}, "'position_max' is [2, 2]; allowed: above"),
        (
            {"parameters": "    position_min: [3, 0]\n    position_max: [1, 1]"},
            "'position_max' is [1, 1]; allowed: above position_min",
        ),
        ({"text": "/**:\n  ros__parameters:\n    joints: [shoulder]\n"}, "'robot_description'"),
        (
            {"text": "/**:\n  ros__parameters:\n    robot_description: {urdf}\n"},
            "parameter 'joints' is not set",
        ),
        ({"text": ROBOT.replace("wrist", "elbow")}, "parameter 'joints' is 'elbow'"),
        ({"text": ROBOT.replace("{urdf}", "/no/such.urdf")}, "/no/such.urdf: no such file"),
        ({"text": "other: 1\n"}, "'other' is not below 'ros__parameters'"),
        ({"text": "/**: 1\n"}, "'/**' is not below 'ros__parameters'"),
        ({"text": "[1, 2\n"}, "robot.yaml, line 2: "),
        ({"text": ""}, "no parameters"),
    ],
)
def test_bad_robots_are_told_in_one_line(write_robot, call, case, message):
    assert message in one_line(call(write_robot(**case), "--samples", 100))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--samples", "0"], "--samples: must be at least 1, is 0"),
        (["--samples", "many"], "--samples: must be a number"),
        (["--seed", "-1"], "--seed: must be at least 0"),
        (["--method", "guess"], "--method: invalid choice"),
        (["--torque-reserve", "1"], "--torque-reserve: must be at least 0 and less than 1"),
        (["--override", "wrist"], "--override: must read JOINT=MIN,MAX"),
        (["--cap", "-2"], "--cap: must be positive"),
    ],
)
def test_bad_usage_is_told_in_one_line(write_robot, call, arguments, message):
    assert message in one_line(call(write_robot(), *arguments), code=2)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--override", "elbow=-1,1"], "override of unknown joint 'elbow'"),
        (["--override", "wrist=1,2"], "joint wrist: override must be finite with min < 0 < max"),
        (["-o", "{tmp}"], "is a directory"),
        (["-o", "{tmp}/none/limits.yaml"], "no directory"),
        (["-o", "{tmp}/robot.yaml"], "is the robot's parameter file"),
        # Where nobody may create a file, root included.
        (["-o", "/proc/limits.yaml"], "/proc cannot be written to"),
    ],
)
def test_options_that_do_not_fit_the_robot(write_robot, call, tmp_path, arguments, message):
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
    output = tmp_path / "limits.yaml"
    output.write_text("old")

    def full(*arguments):
        raise OSError("no space left on device")

    monkeypatch.setattr(limits_file.os, "fsync", full)
    ended = call(write_robot(), "--samples", 300, "-o", output)
    assert "no space left" in one_line(ended)
    assert set(printed(ended)) == {"acceleration_min", "acceleration_max"}
    assert output.read_text() == "old"
