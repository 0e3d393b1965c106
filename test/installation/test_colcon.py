# SPDX-License-Identifier: Apache-2.0
"""A package as a release has it: a copy of its folder alone, built and tested by colcon."""

import os
import shutil
from pathlib import Path

import pytest

from viability_bounds_pkg.testing.executables import run_to_end

pytestmark = pytest.mark.packaging
ROOT = Path(__file__).resolve().parents[2]


def colcon(workspace, *arguments):
    ended = run_to_end(
        *("colcon", "--log-base", workspace / "log", *arguments),
        cwd=workspace,
        # Options of these tests are not for those of the copy.
        env={k: v for k, v in os.environ.items() if not k.startswith("PYTEST_")},
        timeout=300,
    )
    assert ended.returncode == 0, ended.stdout + ended.stderr
    return ended.stdout


def copied(folder, package):
    """Return a workspace with a copy of a package, built without links to its sources."""
    unwanted = shutil.ignore_patterns("__pycache__", "*.egg-info", "build")
    shutil.copytree(ROOT / "src" / package, folder / "src" / package, ignore=unwanted)
    colcon(folder, "build", "--packages-select", package)
    return folder


def test_colcon_builds_and_tests_a_copy_of_a_package(tmp_path):
    workspace = copied(tmp_path, "sim_bridge")
    tests = ["test/node/test_scenario_node.py", "test/hardware/test_communication.py"]
    colcon(workspace, "test", "--packages-select", "sim_bridge", "--pytest-args", *tests)
    summary = colcon(workspace, "test-result")
    assert int(summary.split("Summary: ")[1].split(" tests")[0]) >= 8
    assert "0 errors, 0 failures" in summary
    share = workspace / "install" / "sim_bridge" / "share" / "sim_bridge"
    own = {path.relative_to(ROOT / "config") for path in (ROOT / "config").rglob("*.yaml")}
    installed = {path.relative_to(share / "config") for path in share.rglob("*.yaml")}
    assert installed == own
    assert not any(path.is_symlink() for path in share.rglob("*.yaml"))
    licence = workspace / "src" / "sim_bridge" / "LICENSE"
    assert licence.read_text() == (ROOT / "LICENSE").read_text()
