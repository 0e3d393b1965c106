# SPDX-License-Identifier: Apache-2.0
"""`scripts/overload.sh`: a short run, and what it makes of a limit that was passed."""

import importlib
import json
import sys
from pathlib import Path

import pytest

from viability_bounds_pkg.testing.executables import run_to_end

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.long
def test_a_stack_that_is_paused_keeps_the_limits(tmp_path):
    words = ["--seconds", "3", "--robot", "baxter_left_arm", "--way", "stack + robot"]
    words += ["--load", "pause safety_stack", "--out", tmp_path]
    run = run_to_end("bash", ROOT / "scripts" / "overload.sh", *words)
    assert run.returncode == 0, run.stdout + run.stderr
    (found,) = json.loads((tmp_path / "metrics.json").read_text())
    assert found["missed"] > 0, "no pause had an effect"
    assert found["periods"] > 200
    assert not found["passed"]
    assert "| pause safety_stack |" in (tmp_path / "report.md").read_text()


@pytest.mark.parametrize(("passed", "code"), [(False, 0), (True, 1)])
def test_it_fails_where_a_limit_was_passed(tmp_path, monkeypatch, capsys, passed, code):
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    overload = importlib.import_module("overload")
    numbers = dict.fromkeys(("periods", "missed", "late", "stopped", "clearance_rad"), 1)
    numbers |= dict.fromkeys(("position_violation_rad", "velocity_violation_rad_s"), 0.1 * passed)
    monkeypatch.setattr(
        overload,
        "measure",
        lambda robot, way, load, *_: (
            numbers
            | {"robot": robot, "way": way, "load": load, "torque_ratio": 1.0, "passed": passed}
        ),
    )
    monkeypatch.setattr(sys, "argv", ["overload", "--out", str(tmp_path)])
    assert overload.main() == code
    lines = (tmp_path / "report.md").read_text().splitlines()
    rows = [line for line in lines if line.startswith("| panda ")]
    assert len(rows) == 13
    assert ("**passed**" in rows[0]) == passed
    assert rows[0] in capsys.readouterr().out
