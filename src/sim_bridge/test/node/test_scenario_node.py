# SPDX-License-Identifier: Apache-2.0
import re
import signal
import subprocess
from contextlib import contextmanager

import pytest
import yaml
from ament_index_python.packages import get_package_prefix

from sim_bridge.node.scenario_node import ScenarioNode
from viability_bounds_pkg.exceptions import SettingError
from viability_bounds_pkg.testing.executables import as_child, run_to_end
from viability_bounds_pkg.testing.ros_harness import config_folder, read_config

DEADLINE = 30.0  # s
VALUES = read_config("panda", "scenario_node")
REST = dict(zip(VALUES["joints"], VALUES["start_positions"], strict=True))


def write(directory, duration, *events) -> str:
    path = directory / "scenario.yaml"
    path.write_text(yaml.safe_dump({"duration": duration, "events": list(events)}))
    return str(path)


def command(*arguments):
    executable = f"{get_package_prefix('sim_bridge')}/lib/sim_bridge/scenario_node"
    return [executable, *map(str, arguments)]


def parameters(*changes):
    yield from ("--ros-args", "--params-file", config_folder() / "panda.yaml")
    for change in changes:
        yield from ("-p", change)


def assert_refused(result, *names):
    assert result.returncode == 2
    lines = result.stderr.strip().splitlines()
    assert len(lines) == 1, result.stderr
    assert re.match("(scenario_node: )?error: ", lines[0])
    assert all(name in lines[0] for name in names), lines[0]


def run(*arguments):
    return run_to_end(*command(*arguments), timeout=DEADLINE)


def test_a_posture_must_have_every_joint(ros, tmp_path):
    some = {name: REST[name] for name in VALUES["joints"][1:]}
    path = write(tmp_path, 1.0, {"time": 0.5, "posture": some})
    with pytest.raises(SettingError, match="'scenario'.*at 0.5 s.*none of panda_joint1$"):
        ros.start(ScenarioNode, VALUES | {"scenario": path})


def test_a_scenario_that_cannot_be_played_is_named(tmp_path):
    path = write(tmp_path, -1.0)
    assert_refused(run(*parameters(f"scenario:={path}")), "parameter 'scenario'", "duration")


def test_an_output_must_be_named():
    assert_refused(run("--out"), "--out")


def test_it_gives_up_when_nobody_answers(tmp_path):
    path = write(tmp_path, 1.0)
    result = run(*parameters(f"scenario:={path}", "ready_timeout:=0.5"))
    assert_refused(result, "nothing has moved", "getting ready")


@contextmanager
def waiting(directory):
    """A scenario node that is up and waits for a robot; its report would go to `directory`."""
    process = subprocess.Popen(
        command("--out", directory / "out", *parameters(f"scenario:={write(directory, 1.0)}")),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=as_child,
    )
    try:
        assert "waiting" in process.stdout.readline()
        yield process
    finally:
        process.kill()
        process.communicate()


@pytest.mark.parametrize("sent", [signal.SIGINT, signal.SIGTERM])
def test_told_to_stop_it_judges_nothing(tmp_path, sent):
    with waiting(tmp_path) as process:
        process.send_signal(sent)
        _, errors = process.communicate(timeout=DEADLINE)
    assert process.returncode == 130, errors
    assert "Traceback" not in errors
    assert not (tmp_path / "out").exists()


class Shown:
    """Takes what would be on the screen."""

    def wait(self, reason):
        self.text = reason

    def show(self, played, state):
        self.text = state


@pytest.mark.parametrize(
    ("reported", "shown"),
    [
        ({}, ""),
        ({"mode": "HOLD", "position_error_m": "nan"}, ""),
        ({"mode": "TRACKING", "position_error_m": "0.002"}, "  pose error 2.00 mm"),
    ],
)
def test_without_a_goal_no_pose_error_is_shown(ros, tmp_path, reported, shown):
    node = ros.start(ScenarioNode, VALUES | {"scenario": write(tmp_path, 1.0)})
    screen = Shown()
    ros.wait_until(lambda: node.awaits)
    node.show(screen)
    assert screen.text == node.awaits
    assert "there is no paused robot, no joint commands" in screen.text
    node._refused = {}
    node.recorder.diagnostics |= {"bullet_node": {"rate_hz": "500"}, "controller_node": reported}
    node.show(screen)
    assert screen.text.startswith(f"{reported.get('mode', '')}  nearest limit panda_joint")
    assert screen.text.endswith(f" rad{shown}  500 Hz")
