# SPDX-License-Identifier: Apache-2.0
"""The demo as a user starts it: what it plays, refuses and leaves behind."""

import json
import os
import signal
import subprocess
from contextlib import suppress
from pathlib import Path

import pytest
import yaml

from viability_bounds_pkg.testing.executables import as_child, run_to_end

ROOT = Path(__file__).resolve().parents[2]
DEMO = ROOT / "scripts" / "demo.sh"
DEADLINE = 300.0  # s


@pytest.mark.parametrize(
    ("arguments", "names"),
    [
        (["no_such_robot"], "unknown robot 'no_such_robot'; there are: baxter_left_arm"),
        (["panda", "no_such_scenario"], "unknown scenario 'no_such_scenario' of panda"),
        (["--no-such-option"], "unknown option '--no-such-option'"),
        (["--bounds", "guessed"], "--bounds is 'guessed'"),
        (["--rate", "0.0"], "--rate is '0.0'"),
        (["--rate"], "--rate needs a value"),
        (["--params", "no/such.yaml"], "no/such.yaml"),
    ],
)
def test_what_it_cannot_play_is_refused_in_one_line(tmp_path, arguments, names):
    result = run_to_end("bash", DEMO, "--out", tmp_path, *arguments)
    assert result.returncode == 2
    assert result.stdout == ""
    (error,) = result.stderr.splitlines()
    assert error.startswith("error: ")
    assert names in error


@pytest.mark.long
def test_an_imperfect_robot_is_played_by_programs_of_their_own(tmp_path):
    scenario = yaml.safe_load((ROOT / "config" / "scenarios" / "panda_demo.yaml").read_text())
    path = tmp_path / "first_goal.yaml"
    path.write_text(yaml.safe_dump({"duration": 0.5, "events": scenario["events"][:1]}))
    words = ["panda", path, "--imperfect", "--processes", "--out", tmp_path]
    result = run_to_end("bash", DEMO, *words, timeout=DEADLINE)
    assert result.returncode == 0, result.stdout + result.stderr
    assert "VERDICT: no limit was broken" in result.stdout
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["deadline_misses"] == metrics["braked_periods"] == 0
    assert max(joint["max_speed_ratio"] for joint in metrics["joints"].values()) > 0.3


@pytest.mark.long
def test_a_robot_behind_its_makers_protocol_is_judged_by_itself(tmp_path):
    pytest.importorskip("pylibfranka")
    pytest.importorskip("franky_sim")
    scenario = yaml.safe_load((ROOT / "config" / "scenarios" / "fr3_demo.yaml").read_text())
    path = tmp_path / "first_goals.yaml"
    path.write_text(yaml.safe_dump({"duration": 1.0, "events": scenario["events"][:2]}))
    result = run_to_end("bash", DEMO, "fr3", path, "--out", tmp_path, timeout=DEADLINE)
    assert result.returncode == 0, result.stdout + result.stderr
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["deadline_misses"] == 0
    assert 0.1 < metrics["max_torque_rate_ratio"] <= 1.0
    assert max(joint["max_speed_ratio"] for joint in metrics["joints"].values()) > 0.3


@pytest.mark.long
def test_a_signal_takes_down_all_of_it(tmp_path):
    long = tmp_path / "long.yaml"
    long.write_text("{duration: 20.0, events: []}")
    demo = subprocess.Popen(
        ["bash", DEMO, "panda", long, "--out", tmp_path],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=as_child,
    )
    try:
        assert any("nearest limit" in line for line in demo.stdout)  # a quarter is over
        demo.send_signal(signal.SIGINT)
        _, errors = demo.communicate(timeout=DEADLINE)
        assert demo.returncode == 130, errors
        assert "Traceback" not in errors
        with pytest.raises(ProcessLookupError):  # nothing that it has started is left
            os.killpg(demo.pid, 0)
    finally:
        with suppress(ProcessLookupError):
            os.killpg(demo.pid, signal.SIGKILL)
