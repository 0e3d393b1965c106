import ast
from pathlib import Path

import pytest
import rclpy
from rclpy.node import Node

ROOT = Path(__file__).resolve().parent.parent
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
    "diagnostic_msgs",
    "geometry_msgs",
    "rosgraph_msgs",
    "sensor_msgs",
    "std_msgs",
    "std_srvs",
    "trajectory_msgs",
    "visualization_msgs",
}


def modules():
    for package in PACKAGES:
        yield from sorted((ROOT / "src" / package / package).glob("*.py"))


def imports(path):
    """Top-level packages and own modules that a file imports, wherever in it."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def is_about_ros(name):
    """Nodes, their parameters and what is named ros_ may import ROS; the maths may not."""
    return name.startswith("ros_") or name.endswith(("_node", "_parameters"))


@pytest.mark.parametrize(
    "path", [p for p in modules() if not is_about_ros(p.stem)], ids=lambda path: path.stem
)
def test_maths_does_not_import_ros(path):
    for name in imports(path):
        parts = name.split(".")
        assert parts[0] not in ROS, f"{path.name} imports {name}"
        if parts[0] in PACKAGES and len(parts) > 1:
            assert not is_about_ros(parts[1]), f"{path.name} imports {name}"


@pytest.mark.parametrize("path", list(modules()), ids=lambda path: path.stem)
def test_arrows_between_packages_go_one_way(path):
    package = path.parent.name
    imported = {name.split(".")[0] for name in imports(path)} & set(PACKAGES)
    assert imported - {package} <= PACKAGES[package]


@pytest.mark.parametrize(
    "path", [p for p in modules() if p.stem.endswith("_node")], ids=lambda path: path.stem
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
            getattr(b, "id", "") == "Node" for b in each.bases
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


def test_packages_are_described_alike():
    for package in PACKAGES:
        folder = ROOT / "src" / package
        text = (folder / "package.xml").read_text()
        assert "<build_type>ament_python</build_type>" in text
        assert f"<name>{package}</name>" in text
        assert "<license>Apache-2.0</license>" in text
        assert (folder / "resource" / package).exists()
        assert f"script_dir=$base/lib/{package}" in (folder / "setup.cfg").read_text()
