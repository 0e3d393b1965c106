# SPDX-License-Identifier: Apache-2.0
"""The URDF of a new robot: through xacro, with a tool; its shapes."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pinocchio as pin

from torque_safety_controller.new_robot.chain import NewRobotError
from viability_bounds_pkg.robot.description import load_geometry
from viability_bounds_pkg.robot.files import (
    RobotDescriptionError,
    package_folder,
    with_near_packages,
)


def through_xacro(path: Path, mappings: Mapping[str, str]) -> str:
    """Return the URDF that a xacro file and its arguments make.

    Raises:
        NewRobotError: it fails; names all arguments that it lacks.
    """
    try:
        import xacro
        from xacro import substitution_args
    except ImportError as error:
        raise NewRobotError(
            f"{path} is for xacro, which is not installed; pip install xacro, or apt install "
            "ros-jazzy-xacro"
        ) from error

    def find(package: str) -> str:
        """Return the folder of a package; xacro itself looks at AMENT_PREFIX_PATH only."""
        return str(package_folder(package, path))

    substitution_args._eval_find = find
    text = without_comments(path.read_text(encoding="utf-8", errors="replace"))
    defaults = _defaults(text)
    try:
        # The name of the robot may be an argument, which xacro reads before its default.
        given = {name: each for name, each in defaults.items() if "$" not in each} | dict(mappings)
        urdf: str = xacro.process_file(str(path), mappings=given).toprettyxml(indent="  ")
    except Exception as error:  # of many kinds: of its own, of XML, of Python in the file
        cause: Any = error
        while isinstance(inner := getattr(cause, "exc", None), Exception):
            cause = inner
        why = " ".join(str(cause).split())
        remedy = "give it what it asks for"
        if isinstance(cause, substitution_args.ArgException):
            asked = [str(cause), *re.findall(r"\$\(arg (\w+)\)", text)]
            lacking = dict.fromkeys(name for name in asked if name not in {*defaults, *mappings})
            why = f"it has no argument {', '.join(map(repr, lacking))}"
            remedy = f"give {' '.join(f'{name}:=VALUE' for name in lacking)}"
        elif isinstance(cause, RobotDescriptionError):
            remedy = "set ROS_PACKAGE_PATH to the folder with it"
        elif defaults:
            remedy = f"its arguments are {', '.join(defaults)}"
        raise NewRobotError(f"xacro {path} fails: {why}; {remedy}") from error
    return with_near_packages(urdf, path)


def without_comments(text: str) -> str:
    """Return XML without its comments, in which calls of xacro may be left."""
    return re.sub("<!--.*?-->", "", text, flags=re.DOTALL)


def _defaults(text: str) -> dict[str, str]:
    """Return the arguments of a xacro file that have defaults; none if it is not well-formed."""
    with contextlib.suppress(ElementTree.ParseError):
        root = ElementTree.fromstring(text)
        arguments = [each.attrib for each in root.iter() if str(each.tag).endswith("}arg")]
        return {each["name"]: each["default"] for each in arguments if len(each) == 2}
    return {}


def with_tool(urdf: str, tip: str, mass: float, centre: str) -> str:
    """Return a URDF with a mass fixed to a link; unchanged if it has no such link."""
    root = ElementTree.fromstring(urdf)
    if tip not in [link.get("name") for link in root.findall("link")]:
        return urdf
    name = f"{tip}_tool"
    inertial = ElementTree.SubElement(ElementTree.SubElement(root, "link", name=name), "inertial")
    ElementTree.SubElement(inertial, "origin", xyz=centre)
    ElementTree.SubElement(inertial, "mass", value=f"{mass:g}")
    moments = dict.fromkeys(("ixx", "ixy", "ixz", "iyy", "iyz", "izz"), "0")
    ElementTree.SubElement(inertial, "inertia", moments)
    joint = ElementTree.SubElement(root, "joint", name=name, type="fixed")
    ElementTree.SubElement(joint, "parent", link=tip)
    ElementTree.SubElement(joint, "child", link=name)
    return ElementTree.tostring(root, encoding="unicode")


def shapes(urdf: str, folder: Path | None, model: pin.Model) -> tuple[pin.GeometryModel, str]:
    """Return the collision shapes of a robot; without them, why.

    Args:
        urdf: text of its URDF.
        folder: of the URDF, where relative names of meshes begin; None if it came from a topic.
        model: of its joints.
    """
    root = ElementTree.fromstring(urdf)
    for mesh in root.iter("mesh"):
        name = mesh.get("filename", "")
        if folder is not None and "://" not in name and (folder / name).is_file():
            mesh.set("filename", str(folder / name))
    try:
        geometry = load_geometry(ElementTree.tostring(root, encoding="unicode"), model)
    except RobotDescriptionError as error:
        return pin.GeometryModel(), str(error).splitlines()[0]
    return geometry, "" if geometry.ngeoms else "the URDF has no collision shapes"
