# SPDX-License-Identifier: Apache-2.0
"""Every command that the README shows works."""

import json
import re
import shutil
import subprocess
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).resolve().parent.parent
README = (ROOT / "README.md").read_text()

# Shorter than by default: here it is only shown that they run.
SHORTER = {
    "bash scripts/bench.sh chain": "bash scripts/bench.sh chain --cycles 200",
    "bash scripts/bench.sh step": "bash scripts/bench.sh step --rounds 2",
    "bash scripts/bench.sh compliance": "bash scripts/bench.sh compliance --steps 200",
}
NOT_HERE = {"bash scripts/test.sh"}
"""What runs this test."""


def commands():
    found = [
        line.split("#")[0].strip()
        for block in re.findall(r"```bash\n(.*?)```", README, re.DOTALL)
        for line in block.splitlines()
    ]
    found += re.findall(r"`(bash scripts/[^`]+)`", README)
    return sorted({SHORTER.get(c, c) for c in found if c} - NOT_HERE)


def run(command, tree=ROOT):
    return subprocess.run(
        command.split(), cwd=tree, capture_output=True, text=True, timeout=300, check=False
    )


def hurry(entry, factor):
    """Let a scenario, or an entry in one, last another time."""
    for key, value in entry.items():
        if key in ("time", "duration", "period"):
            entry[key] = factor * value
        elif isinstance(value, dict):
            hurry(value, factor)


@pytest.fixture(scope="module")
def hurried(tmp_path_factory):
    """A tree like this one, with scenarios of half a second; `test_demo.py` plays them in full."""
    tree = tmp_path_factory.mktemp("tree")
    (tree / "install").symlink_to(ROOT / "install")
    (tree / "scripts").mkdir()
    for script in (ROOT / "scripts").glob("*.sh"):
        (tree / "scripts" / script.name).symlink_to(script)
    (tree / "scripts" / "setup.sh").unlink()
    (tree / "scripts" / "setup.sh").write_text(f"source '{ROOT}/scripts/setup.sh'\n")
    shutil.copytree(ROOT / "config", tree / "config")
    for path in (tree / "config" / "scenarios").iterdir():
        scenario = yaml.safe_load(path.read_text())
        factor = 0.5 / scenario["duration"]
        for entry in (scenario, *scenario["events"]):
            hurry(entry, factor)
        path.write_text(yaml.safe_dump(scenario))
    return tree


def test_there_are_commands():
    assert "bash scripts/demo.sh" in commands()
    assert any("reproduce" in command for command in commands())


@pytest.mark.parametrize("command", commands())
def test_command_runs(hurried, command):
    if "scripts/demo.sh" not in command or "--help" in command:
        result = run(command)
        assert result.returncode == 0, result.stdout + result.stderr
        return
    result = run(command, hurried)
    metrics = json.loads((hurried / "results" / "demo" / "metrics.json").read_text())
    robot = re.search(r"demo.sh (\w+)", command)
    assert metrics["robot"] == (robot[1] if robot else "baxter_left_arm")
    rate = re.search(r"--rate (\d+)", command)
    assert rate is None or metrics["rate_hz"] == float(rate[1])
    if "--real-time" in command:
        # On a machine that may be busy with anything: the promise is for a robot that gets its
        # commands.
        assert metrics["clock"] == "real_time"
        if metrics["deadline_misses"] > 1:
            assert result.returncode in (0, 1)
            return
    else:
        assert metrics["clock"] == "lockstep"
    assert result.returncode == 0, result.stdout + result.stderr


def test_one_demo_is_in_real_time():
    assert sum("--real-time" in command for command in commands()) == 1


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
