# SPDX-License-Identifier: Apache-2.0
"""Finds what is wrong with a URDF, all at once: its parser stops at one thing, or passes it."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

from viability_bounds_pkg.exceptions import did_you_mean

MOVING = ("revolute", "continuous", "prismatic")
"""Types of joints with one coordinate."""

_TYPES = (*MOVING, "fixed", "floating", "planar")
_OF_NUMBERS = {"mass": 1, "inertia": 1, "origin": 3, "axis": 3}
"""Elements whose attributes are numbers, and how many."""

_MOMENTS = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
_ROUNDING = 0.01
"""Share by which moments of inertia may be impossible: they are rounded, and links are flat."""

_SMALLEST = 1e-12
"""Moment of inertia that is rounding, kg m^2."""


SPEED_LIMITS = "position_based_velocity_limits"
"""Element of a joint, as in Franka's URDF: its speed limit depends on position."""


def speed_limit(joint: Element) -> tuple[float, float]:
    """Return velocity offset, rad/s, and deceleration limit, rad/s^2, of a joint's speed limit.

    Without the element `SPEED_LIMITS` they are 0 and inf: it does not depend on position.

    Raises:
        ValueError: what is wrong with the element.
    """
    element = joint.find(SPEED_LIMITS)
    if element is None:
        return 0.0, math.inf
    needs = (("velocity_offset", 0.0), ("deceleration_limit", 1e-9))
    values = []
    for key, least in needs:
        text = element.get(key, "nothing")
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not least <= value < math.inf:
            allowed = "a number, at least 0" if least == 0.0 else "a number above 0"
            raise ValueError(f"<{SPEED_LIMITS}> has {text!r} for {key}; allowed: {allowed}")
        values.append(value)
    return values[0], values[1]


def urdf_mistakes(root: Element) -> list[str]:
    """Return what is wrong with a URDF whatever it is used for, a line each.

    Args:
        root: element of the robot.
    """
    links, joints = root.findall("link"), root.findall("joint")
    found = [] if root.get("name") else ["<robot> has no name"]
    numbers = []
    for kind, elements in (("link", links), ("joint", joints)):
        for name, count in Counter(each.get("name", "") for each in elements).items():
            if not name:
                found.append(f"a {kind} has no name: number {_nameless(elements)} in the file")
            elif count > 1:
                found.append(f"{kind} '{name}' is there {count} times")
        for each in elements:
            numbers += [f"{kind} '{each.get('name')}': {text}" for text in _no_numbers(each)]
    for joint in joints:
        found += [f"joint '{joint.get('name')}' {text}" for text in _of_joint(joint, links)]
    carried = {end_of(joint, "child") for joint in joints}
    ends = [name for each in links if (name := each.get("name", "")) not in carried]
    found += _loops(joints)
    if not found and len(ends) > 1:  # else it follows from what is wrong
        names = " and ".join(map(repr, ends))
        found.append(f"links {names} hang on nothing, as only one may; join them by fixed joints")
    elif not found and (circle := _circle(joints, ends)):
        found.append(f"link '{circle}' hangs on itself: the joints above it go round in a circle")
    return numbers + found


def inertial_mistakes(
    root: Element, joints: Iterable[str], rotors: Mapping[str, float] | None = None
) -> list[str]:
    """Return what is wrong with the inertias of links that joints move, a line each.

    Args:
        root: element of a robot without `urdf_mistakes`.
        joints: names of those that move; others are locked.
        rotors: inertias of motors by name of the joint, kg m^2; such a joint needs no other.
    """
    links = {each.get("name", ""): each for each in root.findall("link")}
    moving = set(joints)
    found: dict[str, None] = {}  # each once, in order
    idle: dict[str, str] = {}
    for joint in root.findall("joint"):
        name = joint.get("name", "")
        if name not in moving:
            continue
        body = [links[link] for link in _behind(root, joint, moving) if link in links]
        wrong = [
            f"link '{link.get('name')}' {text}" for link in body for text in _of_inertial(link)
        ]
        found |= dict.fromkeys(wrong)
        massless = all(_mass(link) == 0.0 for link in body)
        if massless and not wrong and not (rotors or {}).get(name):
            idle[name] = end_of(joint, "child")
    if idle:
        found[
            f"{about('joint', idle, 'moves', 'move')} no inertia: "
            f"{about('link', idle.values(), 'has', 'have')} no "
            "<inertial> with a mass; write mass and moments of inertia into the URDF, or leave "
            "such joints out by the tip or by --base"
        ] = None
    return list(found)


def about(kind: str, names: Collection[str], one: str, several: str) -> str:
    """Return the beginning of a line about joints or links, with the verb for one or several."""
    shown = ", ".join(f"'{name}'" for name in names)
    return f"{kind} {shown} {one}" if len(names) == 1 else f"{kind}s {shown} {several}"


def inertial_oddities(root: Element, joints: Iterable[str]) -> list[str]:
    """Return what is odd, but does no harm, about inertias of links that joints move.

    Args:
        root: element of a robot without `urdf_mistakes`.
        joints: names of those that move.
    """
    links = {each.get("name", ""): each for each in root.findall("link")}
    moving = set(joints)
    moved = [
        link
        for joint in root.findall("joint")
        if joint.get("name") in moving
        for link in _behind(root, joint)
    ]
    return [
        f"link '{link}' {text}"
        for link in dict.fromkeys(moved)
        if link in links and (text := _odd_moments(links[link]))
    ]


def _behind(root: Element, joint: Element, moving: Collection[str] = ()) -> list[str]:
    """Return the links that hang on a joint, but for those behind joints that move."""
    below: dict[str, list[Element]] = {}
    for each in root.findall("joint"):
        if each.get("name") not in moving:
            below.setdefault(end_of(each, "parent"), []).append(each)
    hanging = [end_of(joint, "child")]
    for link in hanging:  # it grows
        children = (end_of(each, "child") for each in below.get(link, ()))
        hanging += [child for child in children if child not in hanging]
    return hanging


def end_of(joint: Element, end: str) -> str:
    """Return the name of the link at the "parent" or "child" `end` of a joint; may be empty."""
    element = joint.find(end)
    return "" if element is None else element.get("link", "")


def _nameless(elements: Sequence[Element]) -> int:
    return 1 + next(k for k, each in enumerate(elements) if not each.get("name"))


def _no_numbers(owner: Element) -> Iterator[str]:
    """Yield the attributes below a link or joint that are no numbers: the parser takes zero."""
    for element in owner.iter():
        for key, value in element.items() if element.tag in _OF_NUMBERS else ():
            words = value.split()
            if not _are_finite(words):
                yield f"<{element.tag} {key}={value!r}>: no number"
            elif key in ("xyz", "rpy", "value") and len(words) != _OF_NUMBERS[element.tag]:
                yield f"<{element.tag} {key}={value!r}>: takes {_OF_NUMBERS[element.tag]}"


def _are_finite(words: Iterable[str]) -> bool:
    try:
        return all(math.isfinite(float(word)) for word in words)
    except ValueError:
        return False


def _of_joint(joint: Element, links: Sequence[Element]) -> Iterator[str]:
    names = [each.get("name", "") for each in links]
    kind = joint.get("type")
    if kind is None:
        yield f"has no type; it is one of {', '.join(_TYPES)}"
    elif kind not in _TYPES:
        yield f"is of type '{kind}'; it must be one of {', '.join(_TYPES)}"
    for end in ("parent", "child"):
        link = end_of(joint, end)
        if not link:
            yield f"has no <{end} link=...>"
        elif link not in names:
            yield f"has the {end} link '{link}', which is not there{did_you_mean(link, names)}"
    axis = joint.find("axis")
    words = axis.get("xyz", "1 0 0").split() if axis is not None else ["1"]
    if kind in MOVING and _are_finite(words) and not any(map(float, words)):
        yield "has an axis without a direction, all zeros"


def _circle(joints: Sequence[Element], roots: Sequence[str]) -> str:
    """Return a link that does not hang on a root; empty if each does."""
    hanging = list(roots)
    for link in hanging:  # it grows; a link hangs on one joint
        hanging += [end_of(each, "child") for each in joints if end_of(each, "parent") == link]
    return next((end for each in joints if (end := end_of(each, "child")) not in hanging), "")


def _loops(joints: Sequence[Element]) -> Iterator[str]:
    """Yield the links that hang on several joints."""
    above: dict[str, list[str]] = {}
    for joint in joints:
        above.setdefault(end_of(joint, "child"), []).append(f"'{joint.get('name')}'")
    for child, names in above.items():
        if child and len(set(names)) > 1:
            yield (
                f"link '{child}' hangs on {' and '.join(names)}: a closed loop, whose motion a "
                "tree of joints does not have; cut it in the URDF where it carries least"
            )


def _mass(link: Element) -> float:
    """Return the mass of a link, kg; NaN if it is no number."""
    mass = link.find("inertial/mass")
    try:
        return 0.0 if mass is None else float(mass.get("value", "0"))
    except ValueError:
        return math.nan


def _of_inertial(link: Element) -> Iterator[str]:
    """Yield what of a link's inertia no body can have."""
    inertial = link.find("inertial")
    if inertial is None or any(_no_numbers(link)):
        return
    mass, inertia = inertial.find("mass"), inertial.find("inertia")
    if mass is None or mass.get("value") is None:
        yield "has an <inertial> without <mass value=...>"
    elif _mass(link) < 0.0:
        yield f"has a mass of {_mass(link):g} kg"
    given = {} if inertia is None else inertia.attrib
    if lacking := [key for key in _MOMENTS if key not in given]:
        yield f"has an <inertia> without {', '.join(lacking)}"
        return
    moments = _moments(given)
    if moments[0] < -moments_slack(moments):
        yield f"has a negative moment of inertia: {shown_moments(moments)}"


def _odd_moments(link: Element) -> str:
    """Return what is odd about a link's moments of inertia; empty if nothing is."""
    inertia = link.find("inertial/inertia")
    if inertia is None or any(_of_inertial(link)):
        return ""
    moments = _moments(inertia.attrib)
    if moments[2] <= moments[0] + moments[1] + moments_slack(moments):
        return ""
    return (
        f"has moments of inertia that no body has: {shown_moments(moments)}, of which none can be "
        "above the sum of the others"
    )


def _moments(given: Mapping[str, str]) -> NDArray[np.float64]:
    """Return the moments about the main axes, in order, shape (3,), kg m^2."""
    ixx, ixy, ixz, iyy, iyz, izz = (float(given[key]) for key in _MOMENTS)
    tensor = np.array([[ixx, ixy, ixz], [ixy, iyy, iyz], [ixz, iyz, izz]])
    moments: NDArray[np.float64] = np.linalg.eigvalsh(tensor)
    return moments


def moments_slack(moments: NDArray[np.float64]) -> float:
    """Return by how much moments of inertia in order, shape (3,), may be impossible, kg m^2."""
    return _ROUNDING * float(np.abs(moments).max()) + _SMALLEST


def shown_moments(moments: NDArray[np.float64]) -> str:
    """Return moments of inertia, shape (3,), kg m^2, in words."""
    return f"about its main axes {', '.join(f'{each:.3g}' for each in moments)} kg m^2"
