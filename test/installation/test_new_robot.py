# SPDX-License-Identifier: Apache-2.0
"""The demo of a robot's parameter file that is not one of those shipped."""

import json
import shutil
from pathlib import Path

import pytest

from viability_bounds_pkg.testing.executables import run_to_end

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.long
def test_without_a_scenario_the_arm_holds_still_and_params_merge(tmp_path):
    arm = shutil.copy(ROOT / "config" / "panda.yaml", tmp_path / "my_arm.yaml")
    params = []
    for name, value in (("rate", "rate_hz: 250.0"), ("start", "hold_kd: 5.0")):
        file = tmp_path / f"{name}.yaml"
        file.write_text(f"/**: {{ros__parameters: {{{value}}}}}\n")
        params += ["--params", file]
    demo = ROOT / "scripts" / "demo.sh"
    done = run_to_end("bash", demo, arm, *params, "--out", tmp_path / "out")
    assert done.returncode == 0, done.stdout + done.stderr
    assert "holds its start posture" in done.stderr
    assert json.loads((tmp_path / "out" / "metrics.json").read_text())["rate_hz"] == 250.0
    missing = run_to_end("bash", demo, arm, *params, "--params", "no/such.yaml")
    assert missing.returncode == 2
    assert "no/such.yaml" in missing.stderr
