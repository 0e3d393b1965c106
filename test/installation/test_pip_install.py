# SPDX-License-Identifier: Apache-2.0
"""The maths without ROS: both packages installed by pip into a fresh virtual environment.

The environment holds the two packages and exactly the distributions that they declare, with what
those declare in turn: links to the files installed here, so that an undeclared import fails, ROS'
among them. What this does not check: that the lowest versions declared suffice, that pip finds
and downloads the dependencies, and other Pythons than the one that runs the tests.
"""

import importlib.metadata as metadata
import re
import shutil
import sys
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from viability_bounds_pkg.testing.executables import run_to_end

pytestmark = pytest.mark.packaging

ROOT = Path(__file__).resolve().parents[2]
OWN = ("viability_bounds_pkg", "torque_safety_controller")
CODE = """
import importlib.util
assert importlib.util.find_spec("rclpy") is None
assert importlib.util.find_spec("pytest") is None
"""


def run(*command):
    ended = run_to_end(*command, timeout=None)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    return ended.stdout


def build_wheels(folder):
    """Build wheels of both packages from copies, because setuptools writes beside its sources."""
    for package in OWN:
        copy = shutil.ignore_patterns("test", "__pycache__", "*.egg-info", "build")
        shutil.copytree(ROOT / "src" / package, folder / package, ignore=copy)
    major_minor = tuple(map(int, metadata.version("setuptools").split(".")[:2]))
    makes_wheels = major_minor >= (70, 1) or shutil.which("wheel") is not None
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "-w", folder]
    command += ["--no-build-isolation"] if makes_wheels else []
    ended = run_to_end(*command, *(folder / package for package in OWN), timeout=None)
    if ended.returncode and not makes_wheels:
        pytest.skip(f"setuptools here makes no wheels, and pip gets no other: {ended.stderr}")
    assert ended.returncode == 0, ended.stderr
    return sorted(folder.glob("*.whl"))


def link_dependencies(requirements, site):
    """Link the files of distributions, and of those they need, into a folder of packages."""
    todo, done = list(requirements), set()
    while todo:
        requirement = Requirement(todo.pop())
        name = re.sub(r"[-_.]+", "-", requirement.name).lower()
        if name in done or name in [own.replace("_", "-") for own in OWN]:
            continue
        if requirement.marker and not requirement.marker.evaluate({"extra": ""}):
            continue
        done.add(name)
        try:
            distribution = metadata.distribution(name)
        except metadata.PackageNotFoundError:
            pytest.skip(f"{name} is not installed as a Python distribution here")
        assert requirement.specifier.contains(distribution.version, prereleases=True), name
        todo += distribution.requires or []
        for file in distribution.files:
            if ".." in file.parts or {"include", "tests"} & set(file.parts):
                continue
            link = site / file
            link.parent.mkdir(parents=True, exist_ok=True)
            if not link.exists():
                link.symlink_to(distribution.locate_file(file).resolve())


@pytest.fixture(scope="module")
def environment(tmp_path_factory):
    folder = tmp_path_factory.mktemp("pip")
    venv = folder / "venv"
    run(sys.executable, "-m", "venv", "--without-pip", venv)
    python = venv / "bin" / "python"
    wheels = build_wheels(folder)
    pip = [sys.executable, "-m", "pip", "--python", python]
    run(*pip, "install", "--quiet", "--no-deps", "--no-index", *wheels)
    site = Path(run(python, "-c", "import site; print(site.getsitepackages()[0])").strip())
    found = metadata.distributions(path=[str(site)])
    link_dependencies([each for own in found for each in own.requires or []], site)
    return venv


def in_environment(environment, *command):
    # No PYTHONPATH, which a sourced ROS sets.
    return run_to_end(
        *(environment / "bin" / command[0], *command[1:]),
        timeout=None,
        env={"PATH": "/usr/bin:/bin", "NUMBA_CACHE_DIR": str(environment / "cache")},
        cwd=environment,
    )


def test_every_module_of_the_maths_can_be_imported(environment):
    modules = []
    for package in OWN:
        for path in sorted((ROOT / "src" / package / package).rglob("*.py")):
            parts = path.relative_to(ROOT / "src" / package).with_suffix("").parts
            if not {"remote", "node", "ros", "parameters", "testing"} & set(parts):
                modules.append(".".join(parts[:-1] if parts[-1] == "__init__" else parts))
    assert len(modules) > 60
    code = CODE + "".join(f"import {module}\n" for module in modules)
    ended = in_environment(environment, "python", "-c", code)
    assert ended.returncode == 0, ended.stderr


@pytest.mark.parametrize("example", ["bounds_alone", "controller_without_ros"])
def test_examples_of_the_maths(environment, example):
    ended = in_environment(environment, "python", ROOT / "examples" / f"{example}.py")
    assert ended.returncode == 0, ended.stdout + ended.stderr


@pytest.mark.parametrize("node", ["bounds_node", "controller_node"])
def test_nodes_say_in_one_line_that_they_need_ros(environment, node):
    ended = in_environment(environment, node)
    assert ended.returncode == 1
    assert ended.stdout == ""
    assert ended.stderr.count("\n") == 1
    assert ended.stderr.startswith(f"{node}: no Python module")
    assert "needs ROS 2 Jazzy" in ended.stderr
