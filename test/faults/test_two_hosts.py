# SPDX-License-Identifier: Apache-2.0
"""Robot and control on two hosts, with a bad network between them, and the page about it."""

import json
import re
from pathlib import Path

import pytest
from network import BUSIER, BUSY, FAST, FREE, play

from viability_bounds_pkg.testing.executables import run_to_end

ROOT = Path(__file__).resolve().parents[2]
SCRIPT = ROOT / "test" / "two_hosts.sh"


@pytest.mark.packaging
def test_limits_are_kept_across_hosts_and_the_arm_goes_on_after_cuts(tmp_path):
    out = tmp_path / "numbers.json"
    result = run_to_end("bash", SCRIPT, "--seconds", "10", "--out", out, timeout=300)
    assert result.returncode == 0, result.stdout + result.stderr
    if "skipped" in result.stdout:
        pytest.skip(result.stdout.strip())
    found = json.loads(out.read_text())
    assert found["kept"]
    assert found["position_violation_rad"] <= 1e-9
    assert found["velocity_violation_rad_s"] <= 1e-9
    assert found["torque_ratio"] <= 1.0 + 1e-9
    assert found["goal_error_rad"] < 0.02
    assert found["deadline_misses"] > 100, "the network is bad"
    assert {"drop", "delay"} <= {*re.findall(r"(\w+):", found["faults"]["touched_joint_commands"])}


@pytest.mark.parametrize("network", [FREE, BUSY, BUSIER], ids=["free", "busy", "busier"])
def test_no_joint_comes_to_its_speed_limit_where_the_control_is_late(network):
    found = play(1, network, 10.0)
    assert found.position == found.speed == 0.0
    assert found.fastest < 0.8 < FAST
    assert found.nearest > 0.01
    assert found.torque < 1.0
    assert found.held > 300
    assert (found.stops > 5) == (network.stalls > 0.0)


def test_it_would_with_disturbances_that_are_estimated_faster_than_commands_act():
    found = play(1, BUSY, 10.0, {"disturbance_time": 0.005})
    assert found.fastest > 0.95
    assert found.moments > 5


def test_where_there_are_no_namespaces_it_says_so_in_one_line(tmp_path):
    unshare = tmp_path / "unshare"
    unshare.write_text("#!/bin/sh\necho 'unshare: Operation not permitted' >&2\nexit 1\n")
    unshare.chmod(0o755)
    result = run_to_end("bash", "-c", f'PATH="{tmp_path}:$PATH" exec bash {SCRIPT}')
    assert (result.returncode, result.stderr) == (0, "")
    assert result.stdout == (
        "two_hosts: skipped: no network namespaces here (unshare: Operation not permitted)\n"
    )


def test_the_page_shows_what_is_tried():
    page, script = (ROOT / "docs" / "hosts.md").read_text(), SCRIPT.read_text()
    started = re.findall(r"^start \w+ (\w+ \w+)", script, re.MULTILINE)
    shown = re.findall(r"ros2 run (\w+ \w+)", page)
    assert sorted(set(shown)) == sorted(started)
    for name in re.findall(r"export (.*)$", page, re.MULTILINE):
        assert f"export {name}" in script
    for file in re.findall(r"config/\w+/\w+\.yaml", page):
        assert file in script
    for rule in re.findall(r"-r (\S+)", page):
        assert f"-r {rule}" in script
