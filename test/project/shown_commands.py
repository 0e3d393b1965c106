# SPDX-License-Identifier: Apache-2.0
"""Commands that pages show, and a tree of files in which they can be run."""

import re
import shutil
from pathlib import Path

import yaml

from viability_bounds_pkg.testing.executables import run_to_end

ROOT = Path(__file__).resolve().parents[2]
SCENARIO_TIME = 0.5
"""How long scenarios last in a tree whose scenarios are hurried, s."""


def blocks(text, language):
    """Return what is in the blocks of code of a language."""
    return re.findall(rf"```{language}\n(.*?)```", text, re.DOTALL)


def commands(text):
    """Return the commands of the bash blocks, and those in sentences."""
    found = [
        line.split("#")[0].strip() for block in blocks(text, "bash") for line in block.splitlines()
    ]
    found += re.findall(r"`(bash scripts/[^`]+)`", text)
    return {command for command in found if command}


def run(command, tree=ROOT):
    return run_to_end(*command.split(), cwd=tree, timeout=300)


def _hurry(entry, factor):
    """Let a scenario, or an entry in one, last another time."""
    for key, value in entry.items():
        if key in ("time", "duration", "period"):
            entry[key] = factor * value
        elif isinstance(value, dict):
            _hurry(value, factor)


def make_tree(tree):
    """Make a tree like this one, with results of its own, that lacks a `config`."""
    (tree / "install").symlink_to(ROOT / "install")
    (tree / "scripts").mkdir()
    for script in (ROOT / "scripts").glob("*.sh"):
        (tree / "scripts" / script.name).symlink_to(script)
    (tree / "scripts" / "setup.sh").unlink()
    (tree / "scripts" / "setup.sh").write_text(f"source '{ROOT}/scripts/setup.sh'\n")
    return tree


def make_hurried_tree(tree):
    """Make a tree like this one with short scenarios."""
    make_tree(tree)
    shutil.copytree(ROOT / "config", tree / "config")
    for path in (tree / "config" / "scenarios").glob("*.yaml"):
        scenario = yaml.safe_load(path.read_text())
        factor = SCENARIO_TIME / scenario["duration"]
        for entry in (scenario, *scenario["events"]):
            _hurry(entry, factor)
        path.write_text(yaml.safe_dump(scenario))
    return tree
