# SPDX-License-Identifier: Apache-2.0
"""Every command that the README shows works."""

import json
import re
import subprocess
from pathlib import Path

import pytest
from test_demo import SHOWN

ROOT = Path(__file__).resolve().parent.parent
README = (ROOT / "README.md").read_text()

# Shorter than by default: here it is only shown that they run.
SHORTER = {
    "bash scripts/bench.sh chain": "bash scripts/bench.sh chain --cycles 200",
    "bash scripts/bench.sh compliance": "bash scripts/bench.sh compliance --steps 200",
}
NOT_HERE = {"bash scripts/test.sh"} | {
    " ".join(("bash scripts/demo.sh", robot, *options, "--lockstep")) for robot, options in SHOWN
}
"""What runs this test, and what another one runs."""


def commands():
    found = [
        line.split("#")[0].strip()
        for block in re.findall(r"```bash\n(.*?)```", README, re.DOTALL)
        for line in block.splitlines()
    ]
    found += re.findall(r"`(bash scripts/[^`]+)`", README)
    return sorted({SHORTER.get(c, c) for c in found if c} - NOT_HERE)


def run(command):
    return subprocess.run(
        command.split(), cwd=ROOT, capture_output=True, text=True, timeout=300, check=False
    )


def test_there_are_commands():
    assert "bash scripts/demo.sh" in commands()
    assert any("reproduce" in command for command in commands())


@pytest.mark.parametrize("command", commands())
def test_command_runs(tmp_path, command):
    # Only one of them writes where all do by default.
    result = run(f"{command} --out {tmp_path}" if "--lockstep" in command else command)
    if command == "bash scripts/demo.sh":
        # In real time, on a machine that may be busy with anything: the promise is for a robot
        # that gets its commands.
        metrics = json.loads((ROOT / "results" / "demo" / "metrics.json").read_text())
        assert metrics["clock"] == "real_time"
        if metrics["deadline_misses"] > 1:
            assert result.returncode in (0, 1)
            return
    assert result.returncode == 0, result.stdout + result.stderr


def console():
    return "\n".join(re.findall(r"```console\n(.*?)```", README, re.DOTALL))


def test_console_blocks_name_executables_that_exist():
    shown = re.findall(r"ros2 run (\w+) (\w+)", console())
    assert shown
    for package, executable in shown:
        assert (ROOT / "install" / package / "lib" / package / executable).exists()


def test_console_blocks_name_files_that_exist():
    shown = re.findall(r"(?:\./|config/|examples/)[\w/.]+", console())
    assert shown
    for name in shown:
        assert (ROOT / name).exists(), name


def test_it_is_short():
    assert len(README.splitlines()) <= 200
