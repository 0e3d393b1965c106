# SPDX-License-Identifier: Apache-2.0
"""The demo as a user starts it."""

import json
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
KEYS = {
    "robot",
    "rate_hz",
    "steps",
    "max_position_violation_rad",
    "max_velocity_violation_rad_s",
    "max_torque_ratio",
    "final_position_error_m",
    "deadline_misses",
    "latency_p50_us",
    "latency_p99_us",
}


def demo(*arguments):
    return subprocess.run(
        ["bash", ROOT / "scripts" / "demo.sh", *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


SHOWN = (
    ("baxter_left_arm", ()),
    ("baxter_left_arm", ("--rate", "1000")),
    ("panda", ()),
)
"""Robots and options; the README shows some, which need not run twice."""


@pytest.mark.parametrize(("robot", "options"), SHOWN)
def test_exact_bounds_break_no_limit(tmp_path, robot, options):
    result = demo(robot, "--lockstep", "--out", tmp_path, *options)
    assert result.returncode == 0, result.stdout + result.stderr
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert set(metrics) >= KEYS
    assert metrics["robot"] == robot
    assert metrics["max_position_violation_rad"] <= 1e-9
    assert metrics["max_velocity_violation_rad_s"] <= 1e-9
    assert metrics["max_torque_ratio"] <= 1.0 + 1e-9
    assert metrics["final_position_error_m"] < 1e-3
    assert metrics["final_orientation_error_rad"] < 1e-3
    # The run is worth something only if it goes to the limit.
    closest = min(
        min(row["lower_clearance_rad"], row["upper_clearance_rad"])
        for row in metrics["joints"].values()
    )
    assert closest < 5e-3
    assert metrics["deadline_misses"] == 0
    assert (tmp_path / "figure.png").stat().st_size > 50_000
    assert (tmp_path / "data.npz").exists()
    assert "no limit was broken" in result.stdout
    assert all(name in result.stdout for name in metrics["joints"])


def test_naive_bounds_break_the_elbow_and_say_so(tmp_path):
    result = demo("--bounds", "naive", "--lockstep", "--out", tmp_path)
    assert result.returncode == 1, result.stdout + result.stderr
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["max_position_violation_rad"] > 0.01
    assert metrics["most_violated_joint"] == "left_e1"
    assert "BROKEN" in result.stdout
    assert "left_e1" in result.stdout


@pytest.mark.parametrize(
    ("arguments", "names"),
    [
        (["no_such_robot"], "no_such_robot"),
        (["panda", "no_such_scenario"], "no_such_scenario"),
        (["--no-such-option"], "--no-such-option"),
        (["--bounds", "guessed", "--lockstep"], "method"),
    ],
)
def test_what_it_cannot_play_is_refused(tmp_path, arguments, names):
    result = demo(*arguments, "--out", tmp_path)
    assert result.returncode == 2
    errors = [line for line in result.stderr.splitlines() if line.startswith("error:")]
    assert len(errors) == 1
    assert names in errors[0]
    assert not (tmp_path / "metrics.json").exists()
