# SPDX-License-Identifier: Apache-2.0
"""Finds a robot description and builds its Pinocchio model.

A URDF is named by a file path or by a ``package://`` URI. Packages are looked up where ROS 2
looks (``AMENT_PREFIX_PATH``, ``ROS_PACKAGE_PATH``) and where the ``example-robot-data`` wheel
puts its robots, so that one parameter file works with both.
"""

from __future__ import annotations

import math
import os
import sys
import warnings
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

from viability_bounds_pkg.exceptions import ArmSafetyError, did_you_mean

_OF_NUMBERS = ("mass", "inertia", "origin", "axis")
"""Elements of a URDF whose attributes are numbers."""


class RobotDescriptionError(ArmSafetyError, ValueError):
    """A URDF that cannot be found or loaded, or that does not fit what is asked of it.

    Attributes:
        parameter: which parameter of a robot is at fault.
    """

    def __init__(self, message: str, parameter: str = "robot_description") -> None:
        self.parameter = parameter
        super().__init__(message)


def unknown_name(
    kind: str, name: str, known: Iterable[str], parameter: str = "robot_description"
) -> RobotDescriptionError:
    """Return the error of a name that the URDF does not have.

    Args:
        kind: what it names, such as "joint".
        name: which is not there.
        known: names that are.
        parameter: that has the name.
    """
    names = list(known)
    hint = did_you_mean(name, names) or f"; the URDF has: {', '.join(names)}"
    return RobotDescriptionError(f"unknown {kind} {name!r}{hint}", parameter)


def package_directories() -> Iterator[Path]:
    """Yield the directories whose children are packages, in order of precedence."""
    for prefix in filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)):
        yield Path(prefix) / "share"
    for root in filter(None, os.environ.get("ROS_PACKAGE_PATH", "").split(os.pathsep)):
        yield Path(root)
    for entry in sys.path:
        yield Path(entry) / "cmeel.prefix" / "share"


def resolve_uri(uri: str) -> Path:
    """Return the file that a path, ``file://`` or ``package://`` URI names.

    Args:
        uri: what to look up; a package name is the first component of a ``package://`` URI.

    Raises:
        RobotDescriptionError: no such file.
    """
    if uri.startswith("package://"):
        relative = uri.removeprefix("package://").lstrip("/")  # some write three
        for directory in package_directories():
            path = directory / relative
            if path.is_file():
                return path
        package = relative.split("/", 1)[0]
        hint = _other_file(*(directory / relative for directory in package_directories()))
        raise RobotDescriptionError(f"{uri}: no package {package!r} holds this file{hint}")
    path = Path(uri.removeprefix("file://")).expanduser()
    if not path.is_file():
        raise RobotDescriptionError(f"{uri}: no such file{_other_file(path)}")
    return path


def _other_file(*paths: Path) -> str:
    """Return a hint at a file beside one that does not exist; empty if none has such a name."""
    beside = [path.parent for path in paths if path.parent.is_dir()]
    return did_you_mean(
        paths[0].name, [each.name for folder in beside for each in folder.iterdir()]
    )


def read_urdf(uri: str) -> str:
    """Return the text of the URDF that `uri` names, checked to be well-formed XML.

    Raises:
        RobotDescriptionError: the file is missing, unreadable or is not a URDF.
    """
    path = resolve_uri(uri)
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise RobotDescriptionError(f"{uri}: {error}") from error
    check_urdf(text, uri)
    return text


def check_urdf(text: str, source: str) -> None:
    """Raise `RobotDescriptionError`, naming `source`, unless `text` is a URDF."""
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise RobotDescriptionError(f"{source}: not well-formed XML ({error})") from error
    if root.tag != "robot":
        raise RobotDescriptionError(f"{source}: root element is <{root.tag}>, not <robot>")
    if any("xacro}" in element.tag for element in root.iter() if isinstance(element.tag, str)):
        raise RobotDescriptionError(f"{source}: is for xacro; xacro {source} > robot.urdf")
    if root.find("link") is None:
        raise RobotDescriptionError(f"{source}: there is no <link> in it")
    # The parser would count an inertia that it cannot read as zero.
    for element in root.iter():
        for name, value in element.items() if element.tag in _OF_NUMBERS else ():
            if not _are_finite(value.split()):
                raise RobotDescriptionError(
                    f"{source}: <{element.tag} {name}={value!r}>: no number"
                )


def _are_finite(words: Iterable[str]) -> bool:
    try:
        return all(math.isfinite(float(word)) for word in words)
    except ValueError:
        return False


def build_model(
    urdf: str,
    joints: Sequence[str],
    locked_positions: Mapping[str, float] | None = None,
    rotor_inertia: ArrayLike | None = None,
) -> pin.Model:
    """Return the Pinocchio model of `joints`, every other joint locked.

    Args:
        urdf: text of the URDF.
        joints: the joints to keep, each with one degree of freedom, in the order that the
            caller's arrays use; Pinocchio must number them in this order.
        locked_positions: where other joints are locked, rad; joints left out are locked at
            Pinocchio's neutral configuration (zero).
        rotor_inertia: of the motors as seen from the joints, N^2 times a rotor's own behind a
            gear of ratio N, shape (n,), kg m^2; none if not given. On the diagonal of M.

    Returns:
        A model with ``nq == nv == len(joints)``. Continuous joints are angles too, with
        infinite position limits.

    Raises:
        RobotDescriptionError: an unknown joint, a planar or floating joint, an order that
            differs from the kinematic one, or rotor inertias that cannot be.
    """
    urdf, continuous = _continuous_as_revolute(urdf)
    try:
        full = pin.buildModelFromXML(urdf)
    except (ValueError, RuntimeError) as error:
        raise RobotDescriptionError(f"URDF does not load: {error}") from error
    for name in joints:
        if not full.existJointName(name):
            raise unknown_name("joint", name, list(full.names)[1:], "joints")
    locked = [i for i in range(1, full.njoints) if full.names[i] not in joints]
    model = pin.buildReducedModel(full, locked, _posture(full, locked_positions))
    kept = list(model.names)[1:]
    for name, joint in zip(kept, list(model.joints)[1:], strict=True):
        if joint.nq != 1 or joint.nv != 1:
            raise RobotDescriptionError(
                f"joint {name!r} is planar or floating; "
                "joints must be revolute, continuous or prismatic",
                "joints",
            )
    if kept != list(joints):
        raise RobotDescriptionError(
            f"joints must be listed once each, from base to tip: {', '.join(kept)}", "joints"
        )
    for index in [i for i, name in enumerate(joints) if name in continuous]:
        model.lowerPositionLimit[index] = -math.inf
        model.upperPositionLimit[index] = math.inf
    if rotor_inertia is not None:
        armature = np.asarray(rotor_inertia, dtype=float)
        if armature.shape != (model.nv,) or not (np.isfinite(armature) & (armature >= 0)).all():
            raise RobotDescriptionError(
                f"rotor_inertia must be {model.nv} finite numbers >= 0, not {armature}",
                "rotor_inertia",
            )
        model.armature = armature
    return model


def _posture(model: pin.Model, positions: Mapping[str, float] | None) -> NDArray[np.float64]:
    """Return coordinates of a model with joints at `positions`, rad, and the others at zero."""
    q = pin.neutral(model)
    for name, position in (positions or {}).items():
        if not model.existJointName(name):
            raise unknown_name("joint", name, list(model.names)[1:], "locked_joints")
        joint = model.joints[model.getJointId(name)]
        if joint.nq != 1:
            raise RobotDescriptionError(
                f"joint {name!r} cannot be locked at one coordinate", "locked_joints"
            )
        q[joint.idx_q] = position
    return q


def inertia_beyond(
    urdf: str, frame: str, locked_positions: Mapping[str, float] | None = None
) -> pin.Inertia:
    """Return the inertia of all that hangs on a link, other joints locked, in the link's axes.

    The link's own inertia is not counted: a force/torque sensor does not feel its housing.

    Args:
        urdf: text of a URDF that loads.
        frame: name of the link.
        locked_positions: where joints beyond are locked, rad; at zero where left out.

    Raises:
        RobotDescriptionError: no such link.
    """
    model = pin.buildModelFromXML(_continuous_as_revolute(urdf)[0])
    if not model.existFrame(frame, pin.FrameType.BODY):
        raise RobotDescriptionError(f"unknown link {frame!r}")
    data = model.createData()
    pin.framesForwardKinematics(model, data, _posture(model, locked_positions))
    root = model.getFrameId(frame, pin.FrameType.BODY)
    beyond = {root}
    total = pin.Inertia.Zero()
    for index, each in enumerate(model.frames):  # parents come first
        if index == root or each.parentFrame not in beyond or index == 0:
            continue
        beyond.add(index)
        inertia, place = each.inertia, data.oMf[index]
        if each.type == pin.FrameType.JOINT:
            # All that moves with the joint; frames fixed to it have their own again.
            inertia, place = model.inertias[each.parentJoint], data.oMi[each.parentJoint]
        elif each.parentJoint != model.frames[root].parentJoint:
            continue
        total = total + (data.oMf[root].inverse() * place).act(inertia)
    return total


def kinematic_order(urdf: str, joints: Sequence[str]) -> tuple[str, ...]:
    """Return `joints` in the order in which `build_model` wants them, base to tip.

    Args:
        urdf: text of a URDF that loads.
        joints: joints that it has, in any order.
    """
    return tuple(name for name in pin.buildModelFromXML(urdf).names if name in joints)


def _continuous_as_revolute(urdf: str) -> tuple[str, set[str]]:
    """Return the URDF with continuous joints made revolute, and their names.

    Pinocchio keeps a continuous joint as (cos, sin), two coordinates for one velocity; the
    nodes exchange angles, so that one coordinate a joint is what everything here wants.
    """
    root = ElementTree.fromstring(urdf)
    names = set()
    for joint in root.iter("joint"):
        if joint.get("type") != "continuous":
            continue
        names.add(joint.get("name", ""))
        joint.set("type", "revolute")
        limit = joint.find("limit")
        if limit is None:
            limit = ElementTree.SubElement(joint, "limit", effort="0", velocity="0")
        limit.set("lower", "-1e9")
        limit.set("upper", "1e9")
    return (ElementTree.tostring(root, encoding="unicode") if names else urdf), names


def load_geometry(
    urdf: str,
    model: pin.Model,
    locked_positions: Mapping[str, float] | None = None,
    kind: str = "collision",
) -> pin.GeometryModel:
    """Return the geometry for a model of `build_model`.

    Args:
        urdf: text of the URDF.
        model: made of it, other joints locked.
        locked_positions: as given to `build_model`, rad.
        kind: "collision" or "visual"; of the latter, shapes that are not understood are left out.

    Raises:
        RobotDescriptionError: a mesh cannot be found or loaded, or a shape is not understood.
    """
    root = ElementTree.fromstring(urdf)
    # Pinocchio's own error does not name the mesh.
    for mesh in root.iterfind(f".//{kind}//mesh"):
        if "://" in (name := mesh.get("filename", "")):
            resolve_uri(name)
    full = pin.buildModelFromXML(urdf)
    directories = [str(path) for path in package_directories() if path.is_dir()]
    which = getattr(pin.GeometryType, kind.upper())
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of Pinocchio, about how it was called
            geometry = pin.buildGeomFromUrdfString(full, urdf, which, directories)
    except (ValueError, RuntimeError) as error:
        raise RobotDescriptionError(f"{kind} geometry does not load: {error}") from error
    if kind == "collision":  # the parser drops shapes that it does not understand
        found = Counter(full.frames[item.parentFrame].name for item in geometry.geometryObjects)
        for link in root.iter("link"):
            name, shapes = link.get("name", ""), len(link.findall("collision"))
            if full.existFrame(name) and found[name] != shapes:
                raise RobotDescriptionError(
                    f"link {name!r}: only {found[name]} of {shapes} collision shapes were "
                    "understood"
                )
    kept = set(model.names)
    locked = [i for i in range(1, full.njoints) if full.names[i] not in kept]
    posture = _posture(full, locked_positions)
    reduced, (geometry,) = pin.buildReducedModel(full, [geometry], locked, posture)
    if list(reduced.names) != list(model.names):
        raise RobotDescriptionError("the model was not made of this URDF")
    return geometry
