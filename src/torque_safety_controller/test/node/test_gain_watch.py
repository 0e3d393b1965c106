# SPDX-License-Identifier: Apache-2.0
"""Warnings of gains beyond what the robot bears, and the tool that prints them."""

from __future__ import annotations

import pytest
from controller_chain import NODE
from rcl_interfaces.msg import Log

from torque_safety_controller.node import gain_watch
from torque_safety_controller.node.controller_node import ControllerNode
from torque_safety_controller.tools.gain_limits import main
from viability_bounds_pkg.ros.given_parameters import note_arguments
from viability_bounds_pkg.testing.ros_harness import config_folder, read_config

ROBOT = "talos_left_arm"
FILE = config_folder() / f"{ROBOT}.yaml"
DECLARED = "/**/bounds_node:\n  ros__parameters: {{{}}}\n"


@pytest.fixture
def declared(tmp_path):
    """Return a function that writes a parameter file of declarations; it returns the path."""

    def write(text):
        path = tmp_path / "declared.yaml"
        path.write_text(DECLARED.format(text))
        return path

    return write


def files(*paths):
    return [word for path in paths for word in ("--params-file", str(path))]


def warnings(ros, *paths):
    """Start a controller that gets these files too; return what it warns of, as it grows."""
    note_arguments(ros.context, ["--ros-args", *files(FILE, *paths)])
    heard = ros.listen(Log, "/rosout")
    values = read_config(ROBOT, NODE)
    node = ros.start(ControllerNode, values)

    def said():
        return [m.msg for m in heard if m.name == node.get_name() and "gain_limits" in m.msg]

    return said


def test_each_gain_that_is_beyond_gets_one_line_and_again_when_it_changes(ros, declared):
    said = warnings(ros, declared("delay: 2"))
    ros.wait_until(lambda: len(said()) == 2, "two warnings")
    first, second = sorted(said())
    assert first.startswith("parameter 'bounds_dt_factor' is 2, but with the delay")
    assert second.startswith("parameter 'integral_lambda' is 100, but with the delay")
    ros.accepts(NODE, integral_lambda=40.0)
    ros.accepts(NODE, pose_kd=2000.0)
    ros.wait_until(lambda: any("'pose_kd' is 2000" in text for text in said()), "a warning")
    assert sum("bounds_dt_factor" in text for text in said()) == 1


def test_gains_that_change_often_are_judged_when_they_stay(ros, declared, monkeypatch):
    """Each judgement takes time from the control loop."""
    judged, judge = [], gain_watch.gain_check

    def gain_check(config, *others):
        judged.append(config.gains.pose_kd)
        return judge(config, *others)

    monkeypatch.setattr(gain_watch, "gain_check", gain_check)
    said = warnings(ros, declared("delay: 2"))
    ros.wait_until(lambda: len(said()) == 2, "what is told at the start")
    for gain in (2000.0, 3000.0, 4000.0, 5000.0):
        ros.accepts(NODE, pose_kd=gain)
    ros.wait_until(lambda: any("'pose_kd' is 5000" in text for text in said()), "a warning")
    assert judged[-1] == 5000.0
    assert len(judged) <= 3  # where accepting takes long, one in between


@pytest.mark.parametrize("text", ["delay: 0", "bounds_dt_factor: 3.0"])
def test_where_nothing_is_declared_nothing_is_said(ros, declared, text):
    said = warnings(ros, declared(text))
    ros.run_for(0.8)
    assert not said()


def test_an_integral_gain_too_high_for_the_rate_is_told_where_nothing_is_declared(ros):
    """Panda at 500 Hz bears 50 1/s in some postures only; a smaller gain is used in the others."""
    note_arguments(ros.context, ["--ros-args", *files(config_folder() / "panda.yaml")])
    heard = ros.listen(Log, "/rosout")
    node = ros.start(ControllerNode, read_config("panda", NODE))
    ros.accepts(NODE, integral_lambda=50.0)
    ros.accepts(NODE, integral_action="joints")
    told = "parameter 'integral_lambda' is 50"
    ros.wait_until(
        lambda: any(m.name == node.get_name() and m.msg.startswith(told) for m in heard), told
    )


def test_declarations_that_are_none_are_left_to_the_node_that_they_are_for(ros, declared):
    said = warnings(ros, declared("delay: two"))
    ros.run_for(0.1)
    assert not said()


# The tool


@pytest.mark.parametrize("robot", ["baxter_left_arm", "panda", ROBOT])
def test_ideal_robots_bear_the_gains_of_their_files(robot, capsys):
    assert main(files(config_folder() / f"{robot}.yaml")) == 0
    assert "exceeded" not in capsys.readouterr().out


def test_the_tool_prints_the_largest_gains_and_says_what_is_exceeded(declared, capsys):
    assert main(files(FILE, declared("delay: 2"))) == 1
    rows = {line.split()[0]: line for line in capsys.readouterr().out.splitlines() if line}
    assert rows["integral_lambda"].split()[:4] == ["integral_lambda", "100", "<=", "49.28"]
    assert rows["integral_lambda"].endswith("exceeded")
    assert rows["bounds_dt_factor"].endswith("exceeded")
    assert not rows["pose_kp"].endswith("exceeded")


def test_missed_deadlines_lengthen_the_horizon_of_the_bounds(declared, capsys):
    assert main(files(FILE, declared("missed_deadlines: 4"))) == 0
    rows = {line.split()[0]: line for line in capsys.readouterr().out.splitlines() if line}
    assert rows["bounds_dt_factor"].split()[1] == "5"


def test_a_step_of_all_encoders_is_exceeded_too(declared, capsys):
    assert main(files(FILE, declared(f"velocity_error: {[0.005] * 9}"))) == 1
    (line,) = (row for row in capsys.readouterr().out.splitlines() if "at rest" in row)
    assert line.endswith("exceeded")


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("delay: -1", "parameter 'delay' is -1"),
        ("motor_bandwidth: [1.0]", "parameter 'motor_bandwidth' is"),
        ("dellay: 1", "unknown parameter 'dellay'; did you mean 'delay'?"),
    ],
)
def test_what_is_wrong_in_a_file_gets_one_line(declared, capsys, text, line):
    assert main(files(FILE, declared(text))) == 1
    said = capsys.readouterr().err
    assert said.startswith("gain_limits: ")
    assert line in said
    assert said.count("\n") == 1
