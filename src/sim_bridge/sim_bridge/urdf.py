# SPDX-License-Identifier: Apache-2.0
"""Rewrites a URDF so that its dynamics in PyBullet equal Pinocchio's reduced model.

PyBullet reads a URDF in ways that silently change the dynamics. Each is prevented here:

- a link without ``<inertial>`` would have a mass of 1 kg: every link made here has one;
- inertia tensors would be diagonalised to a relative 1e-6 only, and one that violates the
  triangle inequality, if only by rounding as a flat link's may, would become zero: the text
  has the principal axes and stand-ins for the moments, which the caller sets after loading;
- joint damping and friction, and joint stops, would act: they are removed.

Links that do not move relative to each other become one, as in Pinocchio's reduced model, from
which masses, axes and placements are taken: PyBullet steps every link, fixed or not, and a
humanoid becomes as fast as its arm. `PreparedUrdf.frames` says where the original links are.

On request it adds what a URDF cannot express: rotors that gears will couple to the joints
(`sim_bridge.bullet.friction` has the reasons), and scaled masses of links.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass
from typing import NamedTuple
from xml.etree.ElementTree import Element, ParseError, SubElement, fromstring, tostring

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from viability_bounds_pkg.robot.description import build_model, kinematic_order, unknown_name
from viability_bounds_pkg.robot.files import RobotDescriptionError, resolve_uri
from viability_bounds_pkg.robot.mistakes import MOVING, end_of

Array = NDArray[np.float64]

# PyBullet makes no stop where lower > upper.
_NO_STOP = {"lower": "1", "upper": "-1", "effort": "0", "velocity": "0"}
# The caller sets the moments of inertia after loading.
_STAND_IN = {"ixx": "1", "ixy": "0", "ixz": "0", "iyy": "1", "iyz": "0", "izz": "1"}


class FramePlacement(NamedTuple):
    """A link of the original URDF as a frame of the link that it became part of.

    Relative to that link's principal frame: centre of mass and principal axes. PyBullet reports
    it in double precision, but URDF frames in single precision.
    """

    link: str
    placement: pin.SE3


class ReducedArm(NamedTuple):
    """Pinocchio's model of the moving joints, and of those on the force/torque sensor."""

    model: pin.Model
    positions: Array  # of its m joints where they do not move, rad or m, shape (m,)
    moving: list[int]  # of its joints, those that move
    mounts: list[str]  # names of the joints on the sensor


@dataclass(frozen=True)
class PreparedUrdf:
    """A URDF for PyBullet, with the inertias that are to be set after loading it."""

    text: str  # without any joints but those asked for
    frames: Mapping[str, FramePlacement]  # of every link of the original URDF
    principal_inertias: Mapping[str, Array]  # to set for each link left, shape (3,), kg m^2
    rotors: Mapping[str, str]  # the joint of the rotor that belongs to a joint, where there is one
    missing: Sequence[str]  # meshes of collision shapes that cannot be found and are left out
    locked: Mapping[str, float]  # the other movable joints of the original URDF, rad or m
    arm: ReducedArm


def prepare_urdf(
    urdf: str,
    joints: Sequence[str],
    locked_positions: Mapping[str, float] | None = None,
    *,
    sensor_frame: str = "",
    mass_scales: Mapping[str, float] | None = None,
    rotor_inertias: Mapping[str, float] | None = None,
) -> PreparedUrdf:
    """Return `urdf` reduced to `joints` and rewritten for PyBullet.

    Args:
        urdf: text of the URDF.
        joints: the joints that move, base to tip: revolute, continuous or prismatic.
        locked_positions: where other joints are locked, rad or m; joints left out are locked
            at zero. Mimic joints are joints like any other here, as they are in Pinocchio.
        sensor_frame: link with which those that it carries do not become one, even if they are
            fixed; none if empty.
        mass_scales: factors for mass and inertia of links, by name.
        rotor_inertias: for each of `joints` that gets a rotor, its inertia, kg m^2 (kg for a
            prismatic joint). The rotors turn about axes fixed to the ground, through their
            centres: neither gravity nor the arm's motion acts on them.

    Raises:
        RobotDescriptionError: a URDF that does not load, a joint that is unknown, repeated, out of
            order, both moved and locked, or without one coordinate; an unknown link, or one scaled
            by other than a finite positive number; a link that carries none as `sensor_frame`.
    """
    try:
        root = fromstring(urdf)
    except ParseError as error:
        raise RobotDescriptionError(f"URDF is not well-formed XML ({error})") from error
    locked = dict(locked_positions or {})
    others = {
        joint.get("name", ""): locked.get(joint.get("name", ""), 0.0)
        for joint in root.findall("joint")
        if joint.get("type") in MOVING and joint.get("name") not in joints
    }
    arm = _reduced_arm(root, joints, locked, sensor_frame, mass_scales or {})
    output = Element("robot", name=root.get("name", "robot"))
    output.extend(deepcopy(root.findall("material")))
    children = {joint.get("name", ""): end_of(joint, "child") for joint in root.findall("joint")}
    links = {link.get("name", ""): link for link in root.findall("link")}
    base = next(name for name in links if name not in children.values())
    frames, inertias = {}, {}
    missing: list[str] = []
    names = [base, *(children[name] for name in list(arm.model.names)[1:])]
    bodies = [
        _append_link(output, name, arm.model.inertias[i] if i else pin.Inertia.Zero())
        for i, name in enumerate(names)
    ]
    for frame in arm.model.frames:
        if frame.type != pin.FrameType.BODY or frame.name not in links:
            continue
        body = bodies[frame.parentJoint]
        placement = body.principal.actInv(frame.placement)
        frames[frame.name] = FramePlacement(names[frame.parentJoint], placement)
        if frame.parentJoint:  # what stands still meets nothing
            shapes = links[frame.name].findall("collision")
            body.element.extend(_placed_shapes(shapes, frame.placement, missing))
    for name, body in zip(names, bodies, strict=True):
        inertias[name] = body.moments
    for i in range(1, arm.model.njoints):
        _append_joint(output, arm, i, names, moves=arm.model.names[i] in joints)
    rotors = {name: f"{name} rotor" for name in rotor_inertias or {}}
    for name, inertia in (rotor_inertias or {}).items():
        _append_rotor(output, base, rotors[name])
        inertias[rotors[name]] = np.full(3, inertia)
    text = tostring(output, encoding="unicode")
    return PreparedUrdf(text, frames, inertias, rotors, missing, others, arm)


def _reduced_arm(
    root: Element,
    joints: Sequence[str],
    locked: Mapping[str, float],
    sensor_frame: str,
    mass_scales: Mapping[str, float],
) -> ReducedArm:
    """Return the model of `joints`, and of the joints on the sensor, which become revolute."""
    for name, position in locked.items():
        if name in joints:
            raise RobotDescriptionError(f"joint {name!r} cannot be both moved and locked")
        if not math.isfinite(position):
            raise RobotDescriptionError(f"joint {name!r} cannot be locked at {position}")
    _scale_masses(root, mass_scales)
    mounts = _joints_on(root, sensor_frame) if sensor_frame else []
    for joint in mounts:
        if joint.get("type") == "fixed":
            joint.set("type", "revolute")
            SubElement(joint, "limit", effort="0", velocity="0")
    names = [joint.get("name", "") for joint in mounts]
    held = {name: locked.get(name, 0.0) for name in names if name not in joints}
    wanted = [*joints, *held]
    text = tostring(root, encoding="unicode")
    order = kinematic_order(text, wanted)
    if [name for name in order if name in joints] != list(joints):
        order = tuple(wanted)  # the model's error says what is wrong with them
    rest = {name: position for name, position in locked.items() if name not in held}
    model = build_model(text, order, rest)
    positions = np.array([held.get(name, 0.0) for name in order])
    return ReducedArm(model, positions, [order.index(name) for name in joints], names)


class _Body(NamedTuple):
    """A link of the new URDF."""

    element: Element
    principal: pin.SE3  # centre of mass and principal axes, in the joint's frame
    moments: Array  # principal ones, shape (3,), kg m^2


def _append_link(output: Element, name: str, inertia: pin.Inertia) -> _Body:
    """Add a link with an inertia in the axes of the joint that moves it."""
    if not (np.isfinite(inertia.inertia).all() and math.isfinite(inertia.mass)):
        raise RobotDescriptionError(f"link {name!r}: its inertia is not finite")
    moments, axes = np.linalg.eigh(inertia.inertia)
    if moments[0] < -1e-9 * abs(moments[2]) or inertia.mass < 0.0:
        raise RobotDescriptionError(f"link {name!r}: mass and inertia must be positive")
    axes[:, 2] *= np.sign(np.linalg.det(axes))  # eigenvectors may come left-handed
    principal = pin.SE3(axes, inertia.lever)
    link = SubElement(output, "link", name=name)
    inertial = SubElement(link, "inertial")
    SubElement(inertial, "origin", _origin_attributes(principal))
    SubElement(inertial, "mass", value=number_text([inertia.mass]))
    SubElement(inertial, "inertia", _STAND_IN)
    return _Body(link, principal, moments)


def _placed_shapes(
    originals: Iterable[Element], placement: pin.SE3, missing: list[str]
) -> list[Element]:
    """Return shapes of a link placed on a body; `missing` receives meshes not found."""
    shapes = []
    for original in originals:
        shape = deepcopy(original)
        origin = shape.find("origin")
        if origin is None:
            origin = SubElement(shape, "origin")
        own = pin.SE3(
            pin.rpy.rpyToMatrix(_read_numbers(origin, "rpy", 3)), _read_numbers(origin, "xyz", 3)
        )
        origin.attrib = _origin_attributes(placement * own)
        try:
            for mesh in shape.iter("mesh"):
                mesh.set("filename", str(resolve_uri(mesh.get("filename", "")).resolve()))
        except RobotDescriptionError as error:
            missing.append(str(error))
        else:
            shapes.append(shape)
    return shapes


def _append_joint(
    output: Element, arm: ReducedArm, i: int, links: Sequence[str], *, moves: bool
) -> None:
    """Add a joint of the model, without friction and damping; fixed unless it `moves`."""
    model = arm.model
    data = model.joints[i].createData()
    model.joints[i].calc(data, arm.positions)
    twist = np.reshape(data.S, 6)
    if not twist.any() or not np.isfinite(twist).all():
        raise RobotDescriptionError(f"joint {model.names[i]!r}: axis without a direction")
    kind = "revolute" if twist[3:].any() else "prismatic"
    joint = SubElement(output, "joint", name=model.names[i], type=kind if moves else "fixed")
    origin = model.jointPlacements[i] if moves else model.jointPlacements[i] * data.M
    SubElement(joint, "origin", _origin_attributes(origin))
    SubElement(joint, "parent", link=links[model.parents[i]])
    SubElement(joint, "child", link=links[i])
    if moves:
        SubElement(joint, "axis", xyz=number_text(twist[3:] if twist[3:].any() else twist[:3]))
        SubElement(joint, "limit", _NO_STOP)


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


def _origin_attributes(transform: pin.SE3) -> dict[str, str]:
    """Return the attributes of the URDF origin that places `transform`."""
    rpy = pin.rpy.matrixToRpy(transform.rotation)
    return {"xyz": number_text(transform.translation), "rpy": number_text(rpy)}


def number_text(values: Iterable[float]) -> str:
    """Return `values` for a URDF, with all their digits."""
    return " ".join(repr(float(value)) for value in values)


def _read_numbers(element: Element | None, name: str, count: int) -> Array:
    """Return the `count` numbers of an attribute, shape (count,); zeros where it is missing."""
    text = None if element is None else element.get(name)
    try:
        numbers = np.array([float(x) for x in text.split()]) if text else np.zeros(count)
    except ValueError:
        numbers = np.empty(0)
    if numbers.shape != (count,) or not np.isfinite(numbers).all():
        raise RobotDescriptionError(f"URDF: {name}={text!r} is not {count} finite number(s)")
    return numbers


def _joints_on(root: Element, link: str) -> list[Element]:
    """Return the joints of the URDF `root` that carry what is mounted on `link`.

    Raises:
        RobotDescriptionError: there is no such link, or nothing is mounted on it.
    """
    known = [element.get("name", "") for element in root.findall("link")]
    if link not in known:
        raise unknown_name("link", link, known)
    joints = [joint for joint in root.findall("joint") if end_of(joint, "parent") == link]
    if not joints:
        raise RobotDescriptionError(f"link {link!r} carries no other link to measure")
    return joints


def _scale_masses(root: Element, scales: Mapping[str, float]) -> None:
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
                    part.set(key, number_text(scale * _read_numbers(part, key, 1)))
