# SPDX-License-Identifier: Apache-2.0
"""Rewrites a URDF so that its dynamics in PyBullet equal Pinocchio's reduced model; payloads.

PyBullet reads a URDF in ways that silently change the dynamics. Each is prevented here:

- a link without ``<inertial>`` would have a mass of 1 kg: every link made here has one;
- inertia tensors would be diagonalised to a relative 1e-6 only, and one that violates the
  triangle inequality, if only by rounding as a flat link's may, would become zero: the text
  has the principal axes and stand-ins for the moments, which the caller sets after loading;
- joint damping and friction, and joint stops, would act: they are removed.

Links that do not move relative to each other become one, with the sum of their inertias:
PyBullet steps every link, fixed or not, and a humanoid becomes as fast as its arm.
`PreparedUrdf.frames` says where each of the original links is.

On request it adds what a URDF cannot express: rotors that gears will couple to the joints
(`sim_bridge.bullet.friction` has the reasons), and scaled masses of links.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field
from typing import NamedTuple
from xml.etree.ElementTree import Element, ParseError, SubElement, fromstring, tostring

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

from viability_bounds_pkg.exceptions import ArmSafetyError
from viability_bounds_pkg.robot.description import (
    RobotDescriptionError,
    resolve_uri,
    unknown_name,
)

Array = NDArray[np.float64]

_MOVABLE = ("revolute", "continuous", "prismatic")
# PyBullet makes no stop where lower > upper.
_NO_STOP = {"lower": "1", "upper": "-1", "effort": "0", "velocity": "0"}
# The caller sets the moments of inertia after loading.
_STAND_IN = {"ixx": "1", "ixy": "0", "ixz": "0", "iyy": "1", "iyz": "0", "izz": "1"}
_ROUNDING = 1e-9  # share of the largest moment of inertia of a payload


class FramePlacement(NamedTuple):
    """A link of the original URDF as a frame of the link that it became part of.

    Relative to that link's principal frame: centre of mass and principal axes. PyBullet reports
    it in double precision, but URDF frames in single precision.
    """

    link: str
    placement: pin.SE3


@dataclass(frozen=True)
class PreparedUrdf:
    """A URDF for PyBullet, with the inertias that are to be set after loading it."""

    text: str  # without any joints but those asked for
    frames: Mapping[str, FramePlacement]  # of every link of the original URDF
    principal_inertias: Mapping[str, Array]  # to set for each link left, shape (3,), kg m^2
    rotors: Mapping[str, str]  # the joint of the rotor that belongs to a joint, where there is one
    missing: Sequence[str]  # meshes of collision shapes that cannot be found and are left out
    locked: Mapping[str, float]  # the other movable joints of the original URDF, rad or m


@dataclass
class _Body:
    """Links that move as one, in the frame of the first of them."""

    name: str
    inertia: pin.Inertia = field(default_factory=pin.Inertia.Zero)
    shapes: list[Element] = field(default_factory=list)


def prepare_urdf(
    urdf: str,
    joints: Sequence[str],
    locked_positions: Mapping[str, float] | None = None,
    *,
    visuals: bool = False,
    sensor_frame: str = "",
    mass_scales: Mapping[str, float] | None = None,
    rotor_inertias: Mapping[str, float] | None = None,
) -> PreparedUrdf:
    """Return `urdf` reduced to `joints` and rewritten for PyBullet.

    Args:
        urdf: text of the URDF.
        joints: the joints that move, in any order: revolute, continuous or prismatic.
        locked_positions: where other joints are locked, rad or m; joints left out are locked
            at zero. Mimic joints are joints like any other here, as they are in Pinocchio.
        visuals: keep the visual shapes, instead of the collision shapes of what moves.
        sensor_frame: link with which those that it carries do not become one, even if they are
            fixed; none if empty.
        mass_scales: factors for mass and inertia of links, by name.
        rotor_inertias: for each of `joints` that gets a rotor, its inertia, kg m^2 (kg for a
            prismatic joint). The rotors turn about axes fixed to the ground, through their
            centres: neither gravity nor the arm's motion acts on them.

    Raises:
        RobotDescriptionError: not a URDF, a joint that is unknown, repeated, both moved and
            locked, or of a type with other than one coordinate; an unknown link, or one scaled
            by other than a finite positive number; a link that carries none as `sensor_frame`; a
        mesh of a visual shape that cannot be found.
    """
    try:
        root = fromstring(urdf)
    except ParseError as error:
        raise RobotDescriptionError(f"URDF is not well-formed XML ({error})") from error
    locked = dict(locked_positions or {})
    types = {joint.get("name", ""): joint.get("type", "") for joint in root.findall("joint")}
    _check_joints(types, joints, locked)
    scale_masses(root, mass_scales or {})
    mounts = joints_on(root, sensor_frame) if sensor_frame else []
    apart = {link_at(joint, "child") for joint in mounts}

    output = Element("robot", name=root.get("name", "robot"))
    output.extend(deepcopy(root.findall("material")))
    merged = _merge_links(_Tree(root), joints, locked, apart, visuals, output)
    if visuals and merged.missing:
        raise RobotDescriptionError("; ".join(merged.missing))
    principal = {body.name: _append_link(output, body) for body in merged.bodies}
    frames = {
        name: FramePlacement(body.name, principal[body.name][0].actInv(placement))
        for name, (body, placement) in merged.placed.items()
    }
    inertias = {name: moments for name, (_, moments) in principal.items()}
    rotors = {name: f"{name} rotor" for name in rotor_inertias or {}}
    for name, inertia in (rotor_inertias or {}).items():
        _append_rotor(output, merged.bodies[0].name, rotors[name])
        inertias[rotors[name]] = np.full(3, inertia)
    others = {
        name: locked.get(name, 0.0)
        for name, kind in types.items()
        if kind in _MOVABLE and name not in joints
    }
    text = tostring(output, encoding="unicode")
    return PreparedUrdf(text, frames, inertias, rotors, merged.missing, others)


class _Tree:
    """The links of a URDF by name, the joints on each, and the name of the root link."""

    def __init__(self, root: Element) -> None:
        self.links = {link.get("name", ""): link for link in root.findall("link")}
        self.joints: dict[str, list[Element]] = {name: [] for name in self.links}
        children = []
        for joint in root.findall("joint"):
            self.joints[_linked(joint, "parent", self.links)].append(joint)
            children.append(_linked(joint, "child", self.links))
        roots = [name for name in self.links if name not in children]
        if len(roots) != 1 or len(set(children)) != len(children):
            raise RobotDescriptionError(f"the links do not form one tree; roots: {roots}")
        self.root = roots[0]


class _Merged(NamedTuple):
    """Bodies made of links that move as one, and where each link is on its body."""

    bodies: list[_Body]  # the first one stands on the ground
    placed: dict[str, tuple[_Body, pin.SE3]]
    missing: list[str]  # meshes that cannot be found


def _merge_links(
    tree: _Tree,
    joints: Sequence[str],
    locked: Mapping[str, float],
    apart: Collection[str],
    visuals: bool,
    output: Element,
) -> _Merged:
    """Merge links that move as one; append the joints between the bodies to `output`."""
    ground = _Body(tree.root)
    merged = _Merged([ground], {}, [])
    pending = [(tree.root, ground, pin.SE3.Identity())]
    while pending:
        name, body, placement = pending.pop()
        merged.placed[name] = body, placement
        link = tree.links[name]
        if body is not ground:  # what stands on the ground takes no part in the dynamics
            body.inertia += _inertia(link, placement)
        if visuals:
            body.shapes += _placed_shapes(link, "visual", placement, merged.missing)
        elif body is not ground:  # what stands still meets nothing
            body.shapes += _placed_shapes(link, "collision", placement, merged.missing)
        for joint in tree.joints[name]:
            joint_name, child = joint.get("name", ""), link_at(joint, "child")
            origin = placement * transform_of(joint.find("origin"))
            moves = joint_name in joints
            if not moves:
                origin = origin * _locked_motion(joint, locked.get(joint_name, 0.0))
            if moves or child in apart:
                output.append(_joint_between(joint, moves, body.name, child, origin))
                merged.bodies.append(_Body(child))
                pending.append((child, merged.bodies[-1], pin.SE3.Identity()))
            else:
                pending.append((child, body, origin))
    return merged


def _check_joints(
    types: Mapping[str, str], joints: Sequence[str], locked: Mapping[str, float]
) -> None:
    """Raise `RobotDescriptionError` unless each joint named exists and can do its part."""
    for name in (*joints, *locked):
        if name not in types:
            movable = (str(each) for each, kind in types.items() if kind != "fixed")
            raise unknown_name("joint", name, movable)
        if types[name] not in _MOVABLE:
            raise RobotDescriptionError(f"joint {name!r} is {types[name]}, none of {_MOVABLE}")
    if not joints or len(set(joints)) != len(joints):
        raise RobotDescriptionError(f"joints must be listed once each, not {list(joints)}")
    for name, position in locked.items():
        if name in joints:
            raise RobotDescriptionError(f"joint {name!r} cannot be both moved and locked")
        if not math.isfinite(position):
            raise RobotDescriptionError(f"joint {name!r} cannot be locked at {position}")


def _linked(joint: Element, end: str, links: Mapping[str, object]) -> str:
    """Return the link at the "parent" or "child" `end` of `joint`."""
    name = link_at(joint, end)
    if name not in links:
        raise RobotDescriptionError(f"joint {joint.get('name')!r}: no {end} link {name!r}")
    return name


def _inertia(link: Element, placement: pin.SE3) -> pin.Inertia:
    """Return the inertia of `link` placed on a body, in the body's frame."""
    total = pin.Inertia.Zero()
    for inertial in link.findall("inertial"):
        mass = read_numbers(inertial.find("mass"), "value", 1)[0]
        xx, xy, xz, yy, yz, zz = (
            read_numbers(inertial.find("inertia"), name, 1)[0]
            for name in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
        )
        moments = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        try:
            own = pin.Inertia(mass, np.zeros(3), moments)
        except RuntimeError as error:
            raise RobotDescriptionError(f"link {link.get('name')!r}: {error}") from error
        total += (placement * transform_of(inertial.find("origin"))).act(own)
    return total


def _placed_shapes(
    link: Element, kind: str, placement: pin.SE3, missing: list[str]
) -> list[Element]:
    """Return the shapes of `link`, placed on a body; `missing` receives meshes not found."""
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
            missing.append(str(error))
        else:
            shapes.append(shape)
    return shapes


def _append_link(output: Element, body: _Body) -> tuple[pin.SE3, Array]:
    """Add `body` to the URDF; return its principal frame and moments, shape (3,)."""
    moments, axes = np.linalg.eigh(body.inertia.inertia)
    axes[:, 2] *= np.sign(np.linalg.det(axes))  # eigenvectors may come left-handed
    frame = pin.SE3(axes, body.inertia.lever)
    link = SubElement(output, "link", name=body.name)
    inertial = SubElement(link, "inertial")
    SubElement(inertial, "origin", origin_attributes(frame))
    SubElement(inertial, "mass", value=number_text([body.inertia.mass]))
    SubElement(inertial, "inertia", _STAND_IN)
    link.extend(body.shapes)
    return frame, moments


def _append_rotor(output: Element, base: str, name: str) -> None:
    """Add a rotor that turns against `base`; the caller sets its inertia, as for all links."""
    inertial = SubElement(SubElement(output, "link", name=name), "inertial")
    SubElement(inertial, "mass", value="1")
    SubElement(inertial, "inertia", _STAND_IN)
    joint = SubElement(output, "joint", name=name, type="revolute")
    SubElement(joint, "parent", link=base)
    SubElement(joint, "child", link=name)
    SubElement(joint, "axis", xyz="0 0 1")
    SubElement(joint, "limit", _NO_STOP)


def _joint_between(
    joint: Element, moves: bool, parent: str, child: str, origin: pin.SE3
) -> Element:
    """Return `joint` placed at `origin` on `parent`, without friction, damping or mimicry."""
    kind = "prismatic" if joint.get("type") == "prismatic" else "revolute"
    result = Element("joint", name=joint.get("name", ""), type=kind if moves else "fixed")
    SubElement(result, "origin", origin_attributes(origin))
    SubElement(result, "parent", link=parent)
    SubElement(result, "child", link=child)
    if not moves:
        return result
    SubElement(result, "axis", xyz=number_text(joint_axis(joint)))
    SubElement(result, "limit", _NO_STOP)
    return result


def _locked_motion(joint: Element, position: float) -> pin.SE3:
    """Return the transform that `joint` makes at `position` (rad or m)."""
    if position == 0.0:  # fixed joints need no axis
        return pin.SE3.Identity()
    motion = position * joint_axis(joint)
    if joint.get("type") == "prismatic":
        return pin.SE3(np.eye(3), motion)
    return pin.SE3(pin.exp3(motion), np.zeros(3))


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


class PayloadError(ArmSafetyError, ValueError):
    """A payload that no body can be, or on a link that does not move."""


def payload_inertia(link: str, mass: float, centre: ArrayLike, moments: ArrayLike) -> pin.Inertia:
    """Return the inertia of a payload in the frame of its link.

    Args:
        link: that it is mounted on, for errors.
        mass: positive, kg.
        centre: of mass, in the link's frame, shape (3,), m.
        moments: of inertia about its centre, in the link's axes: xx, xy, xz, yy, yz, zz, shape
            (6,), kg m^2; zeros for a point mass.

    Raises:
        PayloadError: one of them is invalid.
    """
    c, m = np.asarray(centre, dtype=float), np.asarray(moments, dtype=float)
    if not np.isfinite([mass, *c, *m]).all():
        raise PayloadError(f"payload of link {link!r}: it has numbers that are not finite")
    if not mass > 0.0:
        raise PayloadError(f"payload of link {link!r}: its mass is {mass:g} kg; allowed: > 0")
    xx, xy, xz, yy, yz, zz = m
    matrix = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    small, middle, large = np.linalg.eigvalsh(matrix)
    tolerance = _ROUNDING * max(abs(small), large)
    if small < -tolerance or small + middle < large - tolerance:
        raise PayloadError(
            f"payload of link {link!r}: its principal moments of inertia are {small:g}, "
            f"{middle:g} and {large:g} kg m^2; allowed: none negative, none above the sum of the "
            "others"
        )
    try:
        return pin.Inertia(mass, c, matrix)
    except (RuntimeError, ValueError) as error:  # Pinocchio tolerates less
        raise PayloadError(f"payload of link {link!r}: {error}") from error


def payload_link(link: str) -> str:
    """Return the name of the link that the payload of `link` is in `with_payloads`."""
    return f"{link} payload"


def with_payloads(urdf: str, payloads: Mapping[str, pin.Inertia]) -> str:
    """Return a URDF with payloads, each a link of its own.

    Args:
        urdf: text of the URDF.
        payloads: in the frames of the links that carry them, by link.
    """
    if not payloads:
        return urdf
    root = fromstring(urdf)
    for link, payload in payloads.items():
        name = payload_link(link)
        inertial = SubElement(SubElement(root, "link", name=name), "inertial")
        SubElement(inertial, "origin", xyz=number_text(payload.lever))
        SubElement(inertial, "mass", value=number_text([payload.mass]))
        (xx, xy, xz), (_, yy, yz), (_, _, zz) = payload.inertia.tolist()
        moments = {"ixx": xx, "ixy": xy, "ixz": xz, "iyy": yy, "iyz": yz, "izz": zz}
        SubElement(inertial, "inertia", {key: repr(x) for key, x in moments.items()})
        joint = SubElement(root, "joint", name=name, type="fixed")
        SubElement(joint, "parent", link=link)
        SubElement(joint, "child", link=name)
    return tostring(root, encoding="unicode")
