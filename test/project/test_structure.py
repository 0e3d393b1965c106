# SPDX-License-Identifier: Apache-2.0
"""What may import what, and what the packages' descriptions say."""

import ast
import functools
import re
import sys
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from xml.etree import ElementTree

import pytest
import rclpy
import yaml

from sim_bridge.node.bullet_node import BulletNode
from sim_bridge.node.scenario_node import ScenarioNode
from torque_safety_controller.node.controller_node import ControllerNode
from viability_bounds_pkg.node.bounds_node import BoundsNode
from viability_bounds_pkg.node.estimator_node import EstimatorNode

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = {
    "viability_bounds_pkg": set(),
    "torque_safety_controller": {"viability_bounds_pkg"},
    "sim_bridge": {"viability_bounds_pkg"},
    "franka_bridge": {"viability_bounds_pkg"},
}
"""Which packages each may import."""

ROS = re.compile(r"(rcl|rosgraph|builtin_interfaces|\w+_(msgs|srvs)\b)")
ROS_ROOMS = {"node", "nodes", "ros", "parameters", "testing", "tools", "remote"}
"""Folders whose modules may import ROS."""


def modules(package="*"):
    return [path for path in sorted((ROOT / "src").glob(f"{package}/*/**/*.py")) if is_own(path)]


def is_own(path):
    """Return whether a file is a package's, not of its tests."""
    return path.parts[len(ROOT.parts) + 2] == path.parts[len(ROOT.parts) + 1]


def dotted(path):
    """Return the name that a module is imported by."""
    parts = path.relative_to(ROOT / "src").with_suffix("").parts[1:]
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


@functools.cache
def imports(path):
    """Top-level packages and own modules that a file imports, wherever in it."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            found.add(node.module)
            found.update(f"{node.module}.{alias.name}" for alias in node.names)
    return found


def is_about_ros(name):
    """Nodes, their parameters and tools that run nodes may import ROS; the maths may not."""
    return not ROS_ROOMS.isdisjoint(name.split("."))


def circle(arrows):
    """Return a circle in a graph as a list of nodes, empty if there is none."""
    done, way = set(), []

    def visit(node):
        if node in way:
            return [*way[way.index(node) :], node]
        if node in done:
            return []
        way.append(node)
        for each in sorted(arrows.get(node, ())):
            if found := visit(each):
                return found
        way.pop()
        done.add(node)
        return []

    return next((found for node in sorted(arrows) if (found := visit(node))), [])


def test_maths_does_not_import_ros():
    maths = [path for path in modules() if not is_about_ros(dotted(path))]
    assert len(maths) > 50
    for path in maths:
        for name in imports(path):
            assert not ROS.match(name), f"{path} imports {name}"
            if name.split(".")[0] in PACKAGES:
                assert not is_about_ros(name), f"{path} imports {name}"


def test_arrows_between_packages_go_one_way():
    for package, allowed in PACKAGES.items():
        for path in modules(package):
            imported = {name.split(".")[0] for name in imports(path)} & set(PACKAGES)
            assert imported - {package} <= allowed, path


@pytest.mark.parametrize("depth", [2, 9], ids=["rooms", "modules"])
def test_nothing_imports_each_other_in_a_circle(depth):
    names = {dotted(path): path for path in modules()}
    arrows = {}
    for name, path in names.items():
        short = ".".join(name.split(".")[:depth])
        others = {".".join(each.split(".")[:depth]) for each in imports(path) & set(names)}
        arrows.setdefault(short, set()).update(others - {short, short.split(".")[0]})
    assert circle(arrows) == []


NODES = [BoundsNode, EstimatorNode, ControllerNode, BulletNode, ScenarioNode]
if find_spec("pylibfranka"):  # an extra
    NODES.append(import_module("franka_bridge.node.franka_node").FrankaNode)


@pytest.mark.parametrize("kind", NODES)
def test_nodes_take_no_name_that_rclpy_uses_itself(kind):
    context = rclpy.Context()
    rclpy.init(context=context)
    node = rclpy.create_node("plain", context=context)
    taken = {name for name in {*vars(node), *dir(node)} if not name.startswith("__")}
    node.destroy_node()
    rclpy.shutdown(context=context)
    own = set(vars(kind))
    source = ast.parse(Path(sys.modules[kind.__module__].__file__).read_text())
    for part in ast.walk(source):
        if isinstance(part, ast.Attribute) and isinstance(part.ctx, ast.Store):
            own |= {part.attr} if ast.unparse(part.value) == "self" else set()
    assert own & taken <= {"destroy_node"}  # extended on purpose


def test_all_packages_have_one_version_author_and_licence():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    (author,) = citation["authors"]
    for package in PACKAGES:
        folder = ROOT / "src" / package
        described = ElementTree.parse(folder / "package.xml").getroot()
        setup = (folder / "setup.py").read_text()
        assert described.findtext("name") == package
        assert import_module(package).__version__ == citation["version"]
        assert described.findtext("maintainer") == author["name"]
        assert described.findtext("license") == citation["license"]
        assert f'version="{citation["version"]}"' in setup
        assert described.findtext("version") == citation["version"]
        assert (folder / "LICENSE").read_text() == (ROOT / "LICENSE").read_text()


@pytest.mark.parametrize("package", PACKAGES)
def test_public_names_are_at_the_top_of_their_package(package):
    module = import_module(package)
    for name in getattr(module, "__all__", ()):
        assert getattr(module, name).__name__ == name
        assert name in dir(module)
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = module.nothing


NAMES = "hypothesis matplotlib numba numpy pytest scipy tqdm websockets yaml"
KEYS = {name: f"python3-{name}" for name in NAMES.split()} | {"pybullet": "python3-pybullet-pip"}
"""Keys of rosdep that are not named like the module."""

KEYLESS = {name: name for name in ("daqp", "viser", "trimesh", "mcap")} | {
    "mcap_ros2": "mcap-ros2-support",
    "array_api_compat": "array-api-compat",
    "pylibfranka": "pylibfranka",
    "franky_sim": "franky-sim",
    "mujoco": "mujoco",
}
"""Modules without a key of rosdep; a comment tells what to install."""


@pytest.mark.parametrize("package", PACKAGES)
def test_packages_declare_what_they_import(package):
    text = (ROOT / "src" / package / "package.xml").read_text()
    support = {path.stem for path in (ROOT / "src" / package / "test" / "support").glob("*.py")}
    needs = {"exec": set(), "test": set()}
    shared = (ROOT / "src").glob("*/*/testing/*.py")  # all tests need what these import
    for path in {*(ROOT / "src" / package).rglob("*.py"), *shared}:
        if path.name == "setup.py":
            continue
        kind = "test" if {"test", "testing"} & set(path.relative_to(ROOT).parts) else "exec"
        needs[kind] |= {name.split(".")[0] for name in imports(path)}
    for kind, names in needs.items():
        names -= sys.stdlib_module_names | support | {package}
        for name in names & KEYLESS.keys():
            assert f"pip install {KEYLESS[name]}" in text
        needs[kind] = {KEYS.get(name, name) for name in names - KEYLESS.keys()}
    for kind, wanted in (("exec", needs["exec"]), ("test", needs["test"] - needs["exec"])):
        assert wanted == set(re.findall(f"<{kind}_depend>(.*)</{kind}_depend>", text))


def test_parameter_files_and_scenarios_are_installed():
    share = ROOT / "install" / "sim_bridge" / "share" / "sim_bridge" / "config"
    kept, installed = (
        {path.relative_to(folder): path.read_text() for path in folder.rglob("*.*ml")}
        for folder in (ROOT / "config", share)
    )
    assert len(kept) > 5
    assert installed == kept
