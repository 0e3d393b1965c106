# SPDX-License-Identifier: Apache-2.0
"""Masses, shapes and children of the links of a URDF."""

from __future__ import annotations

import math
from collections.abc import Mapping
from copy import deepcopy
from xml.etree.ElementTree import Element, SubElement

import pinocchio as pin

from sim_bridge.urdf.geometry import number_text, origin_attributes, read_numbers, transform_of
from viability_bounds_pkg.robot_description import RobotDescriptionError, resolve_uri


def scale_masses(root: Element, scales: Mapping[str, float]) -> None:
    """Scale mass and inertia of links of the URDF `root`.

    Raises:
        RobotDescriptionError: an unknown link, or one scaled by other than a finite positive
            number.
    """
    links = {link.get("name", ""): link for link in root.findall("link")}
    for name, scale in scales.items():
        if name not in links:
            raise RobotDescriptionError(f"unknown link {name!r}; the URDF has: {', '.join(links)}")
        if not (math.isfinite(scale) and scale > 0.0):
            raise RobotDescriptionError(f"the mass of link {name!r} cannot be scaled by {scale}")
        for inertial in links[name].findall("inertial"):
            for part in (*inertial.findall("mass"), *inertial.findall("inertia")):
                for key in part.attrib:
                    part.set(key, number_text(scale * read_numbers(part, key, 1)))


def placed_shapes(
    link: Element, kind: str, placement: pin.SE3, missing: list[str] | None = None
) -> list[Element]:
    """Return the shapes of `link` as shapes of the body that it is part of.

    Args:
        link: of a URDF.
        kind: visual or collision.
        placement: of the link on the body.
        missing: receives the meshes that cannot be found, whose shapes are left out.

    Raises:
        RobotDescriptionError: a mesh cannot be found, and `missing` is None.
    """
    shapes = []
    for original in link.findall(kind):
        shape = deepcopy(original)
        origin = shape.find("origin")
        if origin is None:
            origin = SubElement(shape, "origin")
        origin.attrib = origin_attributes(placement * transform_of(origin))
        try:
            for mesh in shape.iter("mesh"):
                mesh.set("filename", str(resolve_uri(mesh.get("filename", "")).resolve()))
        except RobotDescriptionError as error:
            if missing is None:
                raise
            missing.append(str(error))
            continue
        shapes.append(shape)
    return shapes


def carried_links(root: Element, link: str) -> list[str]:
    """Return the links of the URDF `root` that are mounted on `link`.

    Raises:
        RobotDescriptionError: there is no such link, or nothing is mounted on it.
    """
    known = [element.get("name", "") for element in root.findall("link")]
    if link not in known:
        raise RobotDescriptionError(f"unknown link {link!r}; the URDF has: {', '.join(known)}")
    carried = _children(root).get(link)
    if not carried:
        raise RobotDescriptionError(f"link {link!r} carries no other link to measure")
    return carried


def links_beyond(root: Element, link: str) -> set[str]:
    """Return `link` and all its descendants in the URDF `root`."""
    children, pending = _children(root), [link]
    beyond: set[str] = set()
    while pending:
        name = pending.pop()
        beyond.add(name)
        pending += children.get(name, ())
    return beyond


def _children(root: Element) -> dict[str, list[str]]:
    children: dict[str, list[str]] = {}
    for joint in root.findall("joint"):
        parent, child = (link_at(joint, end) for end in ("parent", "child"))
        children.setdefault(parent, []).append(child)
    return children


def link_at(joint: Element, end: str) -> str:
    """Return the name of the link at the "parent" or "child" `end` of a joint; may be empty."""
    element = joint.find(end)
    return "" if element is None else element.get("link", "")
