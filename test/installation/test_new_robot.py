# SPDX-License-Identifier: Apache-2.0
"""From a URDF to an arm that keeps its limits, as a user does it."""

import json
from pathlib import Path

import pytest
import yaml

from torque_safety_controller.tools.new_robot import main
from viability_bounds_pkg.testing.executables import run_to_end

ROOT = Path(__file__).resolve().parents[2]
UR5 = "package://example-robot-data/robots/ur_description/urdf/ur5_robot.urdf"


def demo(*arguments):
    return run_to_end("bash", ROOT / "scripts" / "demo.sh", *arguments)


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    """The parameter file that is made of UR5's URDF."""
    folder = tmp_path_factory.mktemp("config")
    assert main([UR5, "tool0", "--name", "my_arm", "--out", str(folder)]) == 0
    return folder / "my_arm.yaml"


@pytest.mark.long
def test_an_arm_of_six_joints_is_driven_into_limits_and_keeps_them(arm, tmp_path):
    scenario = yaml.safe_load((arm.parent / "scenarios" / "my_arm_demo.yaml").read_text())
    back = scenario["events"][2]["time"]
    path = tmp_path / "first_goal.yaml"
    path.write_text(yaml.safe_dump({"duration": back, "events": scenario["events"][:2]}))
    done = demo(arm, path, "--out", tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "VERDICT: no limit was broken" in done.stdout
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["max_torque_ratio"] <= 1.0
    # The stiff goal drives joints to their limits, at their speed limits.
    assert max(each["max_speed_ratio"] for each in metrics["joints"].values()) > 0.9


@pytest.mark.long
def test_without_a_scenario_the_arm_holds_still_and_params_merge(arm, tmp_path):
    alone = tmp_path / "alone.yaml"
    alone.write_text(arm.read_text())
    files = {}
    for name, value in (("rate", "rate_hz: 250.0"), ("start", "hold_kd: 5.0")):
        files[name] = tmp_path / f"{name}.yaml"
        files[name].write_text(f"/**: {{ros__parameters: {{{value}}}}}\n")
    params = [word for file in files.values() for word in ("--params", file)]
    out = tmp_path / "out"
    done = demo(alone, *params, "--out", out)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "holds its start posture" in done.stderr
    assert json.loads((out / "metrics.json").read_text())["rate_hz"] == 250.0
    missing = demo(alone, "--params", files["rate"], "--params", "no/such.yaml")
    assert missing.returncode == 2
    assert "no/such.yaml" in missing.stderr
