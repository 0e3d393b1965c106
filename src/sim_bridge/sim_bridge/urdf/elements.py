# SPDX-License-Identifier: Apache-2.0
"""Links, frames, axes and numbers as a URDF writes them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from xml.etree.ElementTree import Element

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from viability_bounds_pkg.robot.description import RobotDescriptionError, unknown_name

Array = NDArray[np.float64]


def joint_axis(joint: Element) -> Array:
    """Return the unit axis of `joint`, shape (3,); URDF's default is x."""
    element = joint.find("axis")
    axis = np.array([1.0, 0.0, 0.0]) if element is None else read_numbers(element, "xyz", 3)
    length = float(np.linalg.norm(axis))
    if length == 0.0:
        raise RobotDescriptionError(f"joint {joint.get('name')!r}: axis without a direction")
    return axis / length


def transform_of(origin: Element | None) -> pin.SE3:
    """Return the transform of a URDF origin; identity for None."""
    rotation = pin.rpy.rpyToMatrix(read_numbers(origin, "rpy", 3))
    return pin.SE3(rotation, read_numbers(origin, "xyz", 3))


def origin_attributes(transform: pin.SE3) -> dict[str, str]:
    """Return the attributes of the URDF origin that places `transform`."""
    rpy = pin.rpy.matrixToRpy(transform.rotation)
    return {"xyz": number_text(transform.translation), "rpy": number_text(rpy)}


def number_text(values: Iterable[float]) -> str:
    """Return `values` for a URDF, with all their digits."""
    return " ".join(repr(float(value)) for value in values)


def read_numbers(element: Element | None, name: str, count: int) -> Array:
    """Return the `count` numbers of an attribute, shape (count,); zeros where it is missing."""
    text = None if element is None else element.get(name)
    try:
        numbers = np.array([float(x) for x in text.split()]) if text else np.zeros(count)
    except ValueError:
        numbers = np.empty(0)
    if numbers.shape != (count,) or not np.isfinite(numbers).all():
        raise RobotDescriptionError(f"URDF: {name}={text!r} is not {count} finite number(s)")
    return numbers


def link_at(joint: Element, end: str) -> str:
    """Return the name of the link at the "parent" or "child" `end` of a joint; may be empty."""
    element = joint.find(end)
    return "" if element is None else element.get("link", "")


def joints_on(root: Element, link: str) -> list[Element]:
    """Return the joints of the URDF `root` that carry what is mounted on `link`.

    Raises:
        RobotDescriptionError: there is no such link, or nothing is mounted on it.
    """
    known = [element.get("name", "") for element in root.findall("link")]
    if link not in known:
        raise unknown_name("link", link, known)
    joints = [joint for joint in root.findall("joint") if link_at(joint, "parent") == link]
    if not joints:
        raise RobotDescriptionError(f"link {link!r} carries no other link to measure")
    return joints


def scale_masses(root: Element, scales: Mapping[str, float]) -> None:
    """Scale mass and inertia of links of the URDF `root` by finite positive factors.

    Raises:
        RobotDescriptionError: an unknown link, or another factor.
    """
    links = {link.get("name", ""): link for link in root.findall("link")}
    for name, scale in scales.items():
        if name not in links:
            raise unknown_name("link", name, links)
        if not (math.isfinite(scale) and scale > 0.0):
            raise RobotDescriptionError(f"the mass of link {name!r} cannot be scaled by {scale}")
        for inertial in links[name].findall("inertial"):
            for part in (*inertial.findall("mass"), *inertial.findall("inertia")):
                for key in part.attrib:
                    part.set(key, number_text(scale * read_numbers(part, key, 1)))
