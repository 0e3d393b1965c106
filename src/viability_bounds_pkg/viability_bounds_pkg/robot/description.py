# SPDX-License-Identifier: Apache-2.0
"""Pinocchio models of URDFs."""

from __future__ import annotations

import math
import warnings
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

from viability_bounds_pkg.exceptions import did_you_mean
from viability_bounds_pkg.robot.files import (
    RobotDescriptionError,
    package_directories,
    resolve_uri,
)

_OF_JOINT = " (joint)"


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
    full, continuous = whole_model(urdf)
    for name in joints:
        if not full.existJointName(name):
            raise unknown_name("joint", name, list(full.names)[1:], "joints")
    locked = [i for i in range(1, full.njoints) if full.names[i] not in joints]
    model, _ = _reduced(full, locked, posture(full, locked_positions))
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


def _reduced(
    full: pin.Model,
    locked: list[int],
    q: NDArray[np.float64],
    geometries: Sequence[pin.GeometryModel] = (),
) -> tuple[pin.Model, list[pin.GeometryModel]]:
    """Return a model and geometries with joints locked; the joints of `full` get other names."""
    tell_apart(full)
    reduced, found = pin.buildReducedModel(full, list(geometries), locked, q)
    for k, frame in enumerate(reduced.frames):
        reduced.frames[k].name = frame.name.removesuffix(_OF_JOINT)
    for i in range(1, reduced.njoints):
        reduced.names[i] = reduced.names[i].removesuffix(_OF_JOINT)
    return reduced, list(found)


def tell_apart(full: pin.Model) -> None:
    """Give joints other names, as links may have the same.

    To lock joints Pinocchio looks for their frames by name alone.
    """
    joints = [
        k
        for k, frame in enumerate(full.frames)
        if k > 0 and frame.type in (pin.FrameType.JOINT, pin.FrameType.FIXED_JOINT)
    ]
    for k in joints:
        full.frames[k].name += _OF_JOINT
    for i in range(1, full.njoints):
        full.names[i] += _OF_JOINT


def frame_id(model: pin.Model, name: str) -> int:
    """Return the index of the frame of a link, or of a joint where no link has its name.

    Links and joints may have the same names.

    Raises:
        RobotDescriptionError: there is no such frame.
    """
    kinds = pin.FrameType
    for kind in (kinds.BODY, kinds.JOINT, kinds.FIXED_JOINT, kinds.OP_FRAME, kinds.SENSOR):
        if model.existFrame(name, kind):
            return int(model.getFrameId(name, kind))
    raise unknown_name("frame", name, dict.fromkeys(each.name for each in model.frames))


def posture(model: pin.Model, positions: Mapping[str, float] | None) -> NDArray[np.float64]:
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
    model, _ = whole_model(urdf)
    if not model.existFrame(frame, pin.FrameType.BODY):
        raise RobotDescriptionError(f"unknown link {frame!r}")
    data = model.createData()
    pin.framesForwardKinematics(model, data, posture(model, locked_positions))
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
        urdf: text of the URDF.
        joints: joints that it has, in any order.

    Raises:
        RobotDescriptionError: the URDF does not load.
    """
    return tuple(name for name in whole_model(urdf)[0].names if name in joints)


def whole_model(urdf: str) -> tuple[pin.Model, set[str]]:
    """Return the model of all joints, an angle each, and the names of those that are continuous.

    Raises:
        RobotDescriptionError: the URDF does not load.
    """
    urdf, continuous = _continuous_as_revolute(urdf)
    try:
        return pin.buildModelFromXML(urdf), continuous
    except (ValueError, RuntimeError) as error:
        raise RobotDescriptionError(f"URDF does not load: {error}") from error


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
            if full.existFrame(name, pin.FrameType.BODY) and found[name] != shapes:
                raise RobotDescriptionError(
                    f"link {name!r}: only {found[name]} of {shapes} collision shapes were "
                    "understood"
                )
    kept = set(model.names)
    locked = [i for i in range(1, full.njoints) if full.names[i] not in kept]
    q = posture(full, locked_positions)
    reduced, (geometry,) = _reduced(full, locked, q, [geometry])
    if list(reduced.names) != list(model.names):
        raise RobotDescriptionError("the model was not made of this URDF")
    return geometry
