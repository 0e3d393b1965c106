# SPDX-License-Identifier: Apache-2.0
import json
import re
import signal
import subprocess
from contextlib import contextmanager

import numpy as np
import pytest
import yaml
from chain import load_values, run_chain
from ros_harness import CONFIG, ROOT, read_config

from sim_bridge.nodes.scenario_node import ScenarioNode
from sim_bridge.scenario.report import write_report
from viability_bounds_pkg.exceptions import SettingError

DEADLINE = 30.0  # s
VALUES = read_config("panda", "scenario_node")
REST = dict(zip(VALUES["joints"], VALUES["start_positions"], strict=True))


def write(directory, duration, *events) -> str:
    path = directory / "scenario.yaml"
    path.write_text(yaml.safe_dump({"duration": duration, "events": list(events)}))
    return str(path)


def command(*arguments):
    executable = ROOT / "install" / "sim_bridge" / "lib" / "sim_bridge" / "scenario_node"
    return [executable, *map(str, arguments)]


def parameters(*changes):
    yield from ("--ros-args", "--params-file", CONFIG / "panda.yaml")
    for change in changes:
        yield from ("-p", change)


def assert_refused(result, *names):
    assert result.returncode == 2
    lines = result.stderr.strip().splitlines()
    assert len(lines) == 1, result.stderr
    assert re.match("(scenario_node: )?error: ", lines[0])
    assert all(name in lines[0] for name in names), lines[0]


def run(*arguments):
    return subprocess.run(
        command(*arguments), capture_output=True, text=True, timeout=DEADLINE, check=False
    )


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
        # Started from a job in the background, SIGINT is ignored by inheritance.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
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


def test_a_push_lasts_as_long_as_it_is_meant_to():
    """Longer than the robot holds a push that it hears no more of."""
    values = load_values("panda")
    timeout, duration = 0.2, 1.0  # s
    push = {"link": "panda_link5", "duration": duration, "force": [0.0, 3.0, 0.0]}
    events = [{"time": 0.2, "push": push}, {"time": 0.0, "posture": REST}]
    per_node = {"bullet_node": {"external_wrench_timeout": timeout}}
    result = run_chain(values, {"duration": 2.5, "events": events}, per_node)
    moved = np.abs(result.run.q - values["start_positions"]).max(axis=1)
    t = result.run.t
    # Pushes are sent by the wall clock, so that they may begin and end a bit late.
    at_timeout, at_end = moved[t < 0.2 + timeout][-1], moved[t < 0.2 + duration][-1]
    assert at_end > 2.0 * at_timeout
    assert at_end > 0.8 * moved.max()
    assert moved[-1] < 0.2 * moved.max()
    # The end of a push is nothing that the robot would refuse.
    assert "external_wrench" not in result.robot["commands_refused"]


def test_a_run_without_a_pose_has_metrics_without_a_pose_error(tmp_path, ros):
    values = load_values("panda") | {
        "scenario": write(tmp_path, 0.1, {"time": 0.0, "posture": REST})
    }
    result = run_chain(values, {"duration": 0.1, "events": [{"time": 0.0, "posture": REST}]}, {})
    config = ros.start(ScenarioNode, values).config
    assert write_report(tmp_path / "out", config, result.run, result.robot, {"method": "exact"})

    def refuse(word):
        raise AssertionError(f"{word} is not JSON")

    text = (tmp_path / "out" / "metrics.json").read_text()
    metrics = json.loads(text, parse_constant=refuse)
    assert metrics["final_position_error_m"] is None
    assert metrics["limits_kept"]
