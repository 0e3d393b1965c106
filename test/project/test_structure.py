# SPDX-License-Identifier: Apache-2.0
import ast
import functools
import re
import sys
from importlib import import_module
from pathlib import Path
from xml.etree import ElementTree

import pytest
import rclpy
import yaml
from rclpy.node import Node

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = {
    "viability_bounds_pkg": set(),
    "torque_safety_controller": {"viability_bounds_pkg"},
    "sim_bridge": {"viability_bounds_pkg"},
}
"""Which packages each may import."""

ROS = {
    "rclpy",
    "rcl_interfaces",
    "builtin_interfaces",
    "control_msgs",
    "diagnostic_msgs",
    "geometry_msgs",
    "rosgraph_msgs",
    "sensor_msgs",
    "std_msgs",
    "std_srvs",
    "trajectory_msgs",
    "visualization_msgs",
}


ROS_ROOMS = {"node", "nodes", "ros", "parameters", "testing", "tools", "remote"}
"""Folders whose modules may import ROS."""


def modules():
    for package in PACKAGES:
        yield from sorted((ROOT / "src" / package / package).rglob("*.py"))


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


def graph():
    """Return for each module the modules of this project that it imports."""
    names = {dotted(path): path for path in modules()}
    return {
        name: {each for each in imports(path) if each in names and each != name}
        for name, path in names.items()
    }


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
    for path in modules():
        if is_about_ros(dotted(path)):
            continue
        for name in imports(path):
            assert name.split(".")[0] not in ROS, f"{path} imports {name}"
            if name.split(".")[0] in PACKAGES:
                assert not is_about_ros(name), f"{path} imports {name}"


def test_arrows_between_packages_go_one_way():
    for path in modules():
        package = dotted(path).split(".")[0]
        imported = {name.split(".")[0] for name in imports(path)} & set(PACKAGES)
        assert imported - {package} <= PACKAGES[package], path


def test_every_module_is_looked_at():
    assert len(graph()) > 100
    assert any(name.count(".") == 2 for name in graph())


def test_no_modules_import_each_other_in_a_circle():
    assert circle(graph()) == []


def test_no_rooms_import_each_other_in_a_circle():
    rooms = {}
    for name, imported in graph().items():
        room = ".".join(name.split(".")[:2])
        others = {".".join(each.split(".")[:2]) for each in imported}
        rooms.setdefault(room, set()).update(others - {room, room.split(".")[0]})
    assert circle(rooms) == []


def test_no_folder_is_crowded_and_each_says_what_it_is():
    for package in PACKAGES:
        for folder in {path.parent for path in modules() if dotted(path).startswith(package)}:
            files = list(folder.glob("*.py"))
            assert len(files) <= 14, f"{folder}: {len(files)} modules"
            text = ast.get_docstring(ast.parse((folder / "__init__.py").read_text()))
            assert text, f"{folder} has no docstring"


def test_no_folder_of_tests_is_crowded():
    tests = [*ROOT.glob("test/**/test_*.py"), *ROOT.glob("src/*/test/**/test_*.py")]
    for folder in {path.parent for path in tests}:
        assert len(list(folder.glob("*.py"))) <= 14, folder


@pytest.mark.parametrize(
    "path",
    [p for p in modules() if p.stem.endswith("_node")],
    ids=lambda path: path.stem,
)
def test_nodes_take_no_name_that_rclpy_uses_itself(path):
    context = rclpy.Context()
    rclpy.init(context=context)
    try:
        node = Node("plain", context=context)
        taken = {name for name in {*vars(node), *dir(Node)} if not name.startswith("__")}
        node.destroy_node()
    finally:
        rclpy.shutdown(context=context)
    own = set()
    for each in ast.walk(ast.parse(path.read_text())):
        if isinstance(each, ast.ClassDef) and any(
            getattr(b, "id", "") in ("Node", "ArmNode") for b in each.bases
        ):
            for part in ast.walk(each):
                if isinstance(part, ast.FunctionDef):
                    own.add(part.name)
                elif (
                    isinstance(part, ast.Attribute)
                    and isinstance(part.ctx, ast.Store)
                    and getattr(part.value, "id", "") == "self"
                ):
                    own.add(part.attr)
    assert own, "no node class found"
    assert own & taken <= {"destroy_node"}  # extended on purpose


def setup_arguments(package):
    """Return the arguments of a package's setup() that are written out."""
    tree = ast.parse((ROOT / "src" / package / "setup.py").read_text())
    (call,) = (
        n
        for n in ast.walk(tree)
        if isinstance(n, ast.Call) and n.func.__dict__.get("id") == "setup"
    )
    return {k.arg: k.value.value for k in call.keywords if isinstance(k.value, ast.Constant)}


@pytest.mark.parametrize("package", PACKAGES)
def test_packages_are_described_alike(package):
    folder = ROOT / "src" / package
    described = ElementTree.parse(folder / "package.xml").getroot()
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    arguments = setup_arguments(package)
    assert described.findtext("name") == package
    assert described.findtext("export/build_type") == "ament_python"
    assert described.findtext("version") == arguments["version"] == citation["version"]
    assert f"## [{citation['version']}]" in (ROOT / "CHANGELOG.md").read_text()
    assert described.findtext("description") == arguments["description"]
    (author,) = citation["authors"]
    for role in ("maintainer", "author"):
        assert described.findtext(role) == arguments[role] == author["name"]
        mail = described.find(role).get("email")
        assert mail == arguments[f"{role}_email"] == author["email"]
    assert described.findtext("url") == arguments.get("url") == citation.get("url")
    assert described.findtext("license") == arguments["license"] == citation["license"]
    licence = described.find("license").get("file")
    assert (folder / licence).read_text() == (ROOT / "LICENSE").read_text()
    assert (folder / "resource" / package).exists()
    assert f"script_dir=$base/lib/{package}" in (folder / "setup.cfg").read_text()


@pytest.mark.parametrize("package", PACKAGES)
def test_public_names_are_at_the_top_of_their_package(package):
    module = import_module(package)
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert module.__version__ == citation["version"]
    for name in getattr(module, "__all__", ()):
        assert getattr(module, name).__name__ == name
        assert name in dir(module)
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = module.nothing


KEYS = {
    name: f"python3-{name}"
    for name in (
        "hypothesis",
        "matplotlib",
        "numba",
        "numpy",
        "pytest",
        "scipy",
        "tqdm",
        "websockets",
        "yaml",
    )
} | {"pybullet": "python3-pybullet-pip"}
"""Keys of rosdep that are not named like the module."""

KEYLESS = {name: name for name in ("daqp", "viser", "trimesh", "mcap")} | {
    "mcap_ros2": "mcap-ros2-support"
}
"""Modules without a key of rosdep; a comment tells what to install."""


@pytest.mark.parametrize("package", PACKAGES)
def test_packages_declare_what_they_import(package):
    text = (ROOT / "src" / package / "package.xml").read_text()
    own = {path.stem for path in (ROOT / "src" / package / "test" / "support").glob("*.py")}
    needs = {"exec": set(), "test": set()}
    shared = (ROOT / "src").glob("*/*/testing/*.py")  # all tests need what these import
    for path in {*(ROOT / "src" / package).rglob("*.py"), *shared}:
        if path.name == "setup.py":
            continue
        kind = "test" if {"test", "testing"} & set(path.relative_to(ROOT).parts) else "exec"
        needs[kind] |= {name.split(".")[0] for name in imports(path)}
    for kind, names in needs.items():
        names -= sys.stdlib_module_names | own | {package}
        for name in names & KEYLESS.keys():
            assert f"pip install {KEYLESS[name]}" in text
        needs[kind] = {KEYS.get(name, name) for name in names - KEYLESS.keys()}
    declared = {
        kind: set(re.findall(f"<{kind}_depend>(.*)</{kind}_depend>", text)) for kind in needs
    }
    assert needs["exec"] == declared["exec"]
    assert needs["test"] - needs["exec"] == declared["test"]


def test_parameter_files_and_scenarios_are_installed():
    share = ROOT / "install" / "sim_bridge" / "share" / "sim_bridge" / "config"
    own, installed = (
        {path.relative_to(folder): path.read_text() for path in folder.rglob("*.*ml")}
        for folder in (ROOT / "config", share)
    )
    assert len(own) > 5
    assert installed == own


def test_every_source_names_its_licence():
    folders = ("src", "test", "reproduction", "benchmarks", "examples", "scripts")
    found = [
        p for f in folders for end in ("py", "sh", "yaml") for p in (ROOT / f).rglob(f"*.{end}")
    ]
    assert len(found) > 250
    for path in found:
        if path.stat().st_size:
            start = path.read_text()[:200]
            assert "SPDX-License-Identifier: Apache-2.0" in start, path
