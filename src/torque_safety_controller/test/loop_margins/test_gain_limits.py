# SPDX-License-Identifier: Apache-2.0
"""The tool that prints gains beside the largest that a robot bears."""

from __future__ import annotations

import pytest

from torque_safety_controller.tools.gain_limits import main
from viability_bounds_pkg.testing.ros_harness import config_folder

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
