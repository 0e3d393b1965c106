# SPDX-License-Identifier: Apache-2.0
"""Every script and executable says with --help what it is for."""

import importlib.util
import sys
from importlib.metadata import distribution
from pathlib import Path

import pytest

from viability_bounds_pkg.testing.executables import run_to_end

SCRIPTS = Path(__file__).resolve().parents[2] / "scripts"
SOURCED = {"domain.sh", "environment.sh", "options.sh", "setup.sh"}
PACKAGES = "viability_bounds_pkg", "torque_safety_controller", "sim_bridge", "franka_bridge"
EXTRAS = {
    "moveit_node": ("control_msgs", "apt install ros-jazzy-control-msgs"),
    "franka_node": ("pylibfranka", "source scripts/setup.sh --franka (Python 3.10 to 3.12)"),
    "simulated_fr3": ("mujoco", "source scripts/setup.sh --franka (Python 3.10 to 3.12)"),
    "franka_stack": ("pylibfranka", "source scripts/setup.sh --franka (Python 3.10 to 3.12)"),
}
"""What some programs need that is not installed by default, and how it is."""
EXECUTABLES = {
    entry.name: entry
    for package in PACKAGES
    for entry in distribution(package).entry_points
    if entry.group == "console_scripts"
}


def test_help_of_each_shell_script():
    for script in sorted(SCRIPTS.glob("*.sh")):
        if script.name not in SOURCED:
            result = run_to_end("bash", script, "--help")
            assert (result.returncode, result.stderr) == (0, ""), script
            assert result.stdout.startswith("usage: ")
            assert script.name in result.stdout.splitlines()[0]
    result = run_to_end("bash", "-c", f"source {SCRIPTS}/setup.sh --help && echo it goes on")
    assert result.stdout.startswith("usage: source scripts/setup.sh")
    assert result.stdout.endswith("it goes on\n")


def help_of(main, name, capsys, monkeypatch):
    monkeypatch.setattr(sys, "argv", [name, "--help"])
    with pytest.raises(SystemExit) as end:
        main()
    assert end.value.code == 0
    out = capsys.readouterr().out
    assert out.startswith(f"usage: {name}")
    assert len(out.splitlines()) > 3


@pytest.mark.parametrize("script", sorted(SCRIPTS.glob("*.py")), ids=lambda path: path.name)
def test_help_of_a_python_script(script, capsys, monkeypatch):
    spec = importlib.util.spec_from_file_location(f"script_{script.stem}", script)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    help_of(module.main, script.name, capsys, monkeypatch)


@pytest.mark.parametrize("name", sorted(EXECUTABLES.keys() - EXTRAS.keys()))
def test_help_of_an_executable(name, capsys, monkeypatch):
    help_of(EXECUTABLES[name].load(), name, capsys, monkeypatch)


@pytest.mark.parametrize("name", EXTRAS)
def test_a_program_says_what_it_needs(name, capsys, monkeypatch):
    module, remedy = EXTRAS[name]
    main = EXECUTABLES[name].load()
    if importlib.util.find_spec(module):
        help_of(main, name, capsys, monkeypatch)
    else:
        assert main() == 1
        assert capsys.readouterr().err == f"{name}: no Python module '{module}': {remedy}\n"
