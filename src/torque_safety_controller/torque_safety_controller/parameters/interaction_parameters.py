"""Parameters of forces at the hand and other contacts: the table, and what is made of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pinocchio as pin

from torque_safety_controller.contact.admittance import AdmittanceGains
from torque_safety_controller.contact.contacts import Contacts, FrictionContact
from torque_safety_controller.contact.interaction import Interaction, InteractionSettings
from torque_safety_controller.contact.wrench_sensor import SensorSettings, WrenchSensor
from torque_safety_controller.robot_model import RobotModel
from viability_bounds_pkg.exceptions import SettingError
from viability_bounds_pkg.robot_description import RobotDescriptionError, inertia_beyond
from viability_bounds_pkg.ros.parameters import Parameter, positive
from viability_bounds_pkg.ros.robot_parameters import locked_joints

_AXES = "x, y, z and about x, y, z of the end effector's axes"

TABLE = (
    Parameter("ft_frame", str, "link of the wrist's force/torque sensor; none if empty", ""),
    Parameter(
        "ft_tool_mass",
        float,
        "mass beyond the sensor, kg; -1: as the URDF says, centre of mass included",
        -1.0,
    ),
    Parameter(
        "ft_tool_com",
        list[float],
        "centre of that mass in the sensor's axes, m; the sensor's origin if empty",
        np.zeros(0),
    ),
    Parameter(
        "ft_filter_hz", float, "cut-off frequency of the wrench's filter, Hz", 30.0, live=True
    ),
    Parameter(
        "ft_timeout", float, "how long without a wrench before force control ends, s", 0.05, True
    ),
    Parameter(
        "force_directions",
        list[float],
        f"1 where target_wrench is exerted, 0 elsewhere: {_AXES}; nowhere if empty",
        np.zeros(0),
        live=True,
    ),
    Parameter(
        "force_stiffness",
        list[float],
        "share of pose_kp that is left there, 0 to 1, six numbers; none of it if empty",
        np.zeros(0),
        live=True,
    ),
    Parameter(
        "admittance_kp",
        list[float],
        "gains of (27), m/s^2 per N and rad/s^2 per N m; 5e-3 and 5e-3 if empty",
        np.zeros(0),
        live=True,
    ),
    Parameter(
        "admittance_kd",
        list[float],
        "gains of (27), m/s^2 per N/s and rad/s^2 per N m/s; 1e-7 and 1e-7 if empty",
        np.zeros(0),
        live=True,
    ),
    Parameter(
        "admittance_speed_max",
        list[float],
        "speeds at which the hand looks for what it is to press on, m/s and rad/s; 0.01 and 0.05 "
        "if empty",
        np.zeros(0),
        live=True,
    ),
    Parameter(
        "dual_compliance",
        bool,
        "whether the hand yields to wrenches above yield_threshold, and stays where they end",
        default=False,
        live=True,
    ),
    Parameter(
        "yield_threshold",
        list[float],
        "force and moment above which it does, N and N m; 10 and 2 if empty",
        np.zeros(0),
        live=True,
    ),
    Parameter(
        "yield_kp",
        list[float],
        "gains with which it does, m/s^2 per N and rad/s^2 per N m; 0.1 and 1 if empty",
        np.zeros(0),
        live=True,
    ),
    Parameter(
        "yield_speed_max",
        list[float],
        "speeds at which it yields at most, m/s and rad/s; 0.25 and 1 if empty",
        np.zeros(0),
        live=True,
    ),
    Parameter(
        "contact_frames",
        list[str],
        "links that the QP may use contact forces of, one for each point",
        default=(),
    ),
    Parameter(
        "contact_points",
        list[float],
        "where they touch, three for each point, in the link's axes, m; their origins if empty",
        np.zeros(0),
    ),
    Parameter(
        "contact_normals",
        list[float],
        "where the environment pushes to, three for each point, in the link's axes",
        np.zeros(0),
    ),
    Parameter(
        "contact_friction",
        list[float],
        "coefficient of friction at each point; none if empty",
        np.zeros(0),
    ),
    Parameter(
        "closed_contacts",
        list[str],
        "links but the hand that are in contact at present",
        default=(),
        live=True,
    ),
)


def sensor_settings(values: Mapping[str, Any]) -> SensorSettings:
    """Return how measurements are taken.

    Raises:
        SettingError: a value cannot be used.
    """
    return SensorSettings(positive(values, "ft_filter_hz"), positive(values, "ft_timeout"))


def interaction_settings(values: Mapping[str, Any]) -> InteractionSettings:
    """Return what is done about forces.

    Raises:
        SettingError: a value cannot be used.
    """
    directions = _six(values, "force_directions")
    if not np.isin(directions, (0.0, 1.0)).all():
        raise SettingError("force_directions", directions, "zeros and ones")
    stiffness = _six(values, "force_stiffness")
    if not ((stiffness >= 0.0) & (stiffness <= 1.0)).all():
        raise SettingError("force_stiffness", stiffness, "numbers from 0 to 1")
    for name in ("force_directions", "dual_compliance"):
        if np.any(values[name]) and not values["ft_frame"]:
            raise SettingError(name, values[name], "only with a force/torque sensor, 'ft_frame'")
    frames = _contact_frames(values)
    for frame in values["closed_contacts"]:
        if frame not in frames:
            known = ", ".join(frames) or "none"
            raise SettingError(
                "closed_contacts", list(values["closed_contacts"]), f"of 'contact_frames': {known}"
            )
    threshold = _pair(values, "yield_threshold", (10.0, 2.0))
    return InteractionSettings(
        directions=directions == 1.0,
        stiffness=stiffness,
        gains=AdmittanceGains(
            _pair(values, "admittance_kp", (5e-3, 5e-3), zero=True),
            _pair(values, "admittance_kd", (1e-7, 1e-7), zero=True),
            _pair(values, "admittance_speed_max", (0.01, 0.05)),
        ),
        closed=tuple(frames.index(frame) for frame in values["closed_contacts"]),
        yield_threshold=threshold if values["dual_compliance"] else None,
        yielding_gains=AdmittanceGains(
            _pair(values, "yield_kp", (0.1, 1.0), zero=True),
            (0.0, 0.0),
            _pair(values, "yield_speed_max", (0.25, 1.0)),
        ),
    )


def _pair(
    values: Mapping[str, Any], name: str, default: tuple[float, float], *, zero: bool = False
) -> tuple[float, float]:
    value = values[name]
    if not len(value):
        return default
    if len(value) != 2 or not (np.isfinite(value) & (value >= 0.0)).all():
        raise SettingError(name, value, "two finite numbers >= 0, linear and angular")
    if not zero and not value.all():
        raise SettingError(name, value, "two finite numbers > 0, linear and angular")
    return float(value[0]), float(value[1])


def _six(values: Mapping[str, Any], name: str) -> np.ndarray:
    value = values[name]
    if not len(value):
        return np.zeros(6)
    if len(value) != 6 or not np.isfinite(value).all():
        raise SettingError(name, value, f"six finite numbers: {_AXES}")
    return value


def make_interaction(
    values: Mapping[str, Any],
    robot: RobotModel,
    urdf: str,
    settings: InteractionSettings,
) -> Interaction | None:
    """Return what handles forces; None where there is neither a sensor nor a contact.

    Args:
        values: parameter values by name.
        robot: model of the arm.
        urdf: text of its URDF.
        settings: of `interaction_settings`.

    Raises:
        SettingError: a frame that the URDF does not have or that is not where it must be, or
            a contact that cannot be.
    """
    sensor = _sensor(values, robot, urdf)
    contacts = _contacts(values, robot.model)
    if sensor is None and contacts is None:
        return None
    hand, placement = None, None
    if contacts is not None and sensor is not None:
        on_hand = [
            index
            for index, contact in enumerate(contacts.contacts)
            if _joint_of(robot.model, contact.frame) == _joint_of(robot.model, robot.frame)
        ]
        if len(on_hand) > 1:
            frames = list(values["contact_frames"])
            raise SettingError("contact_frames", frames, "one link that is fixed to the hand")
        if on_hand:
            hand = on_hand[0]
            placement = _between(robot.model, robot.frame, contacts.contacts[hand].frame)
    return Interaction(sensor, contacts, hand, placement, settings)


def _sensor(values: Mapping[str, Any], robot: RobotModel, urdf: str) -> WrenchSensor | None:
    frame, model = values["ft_frame"], robot.model
    if not frame:
        return None
    if not model.existFrame(frame, pin.FrameType.BODY):
        raise SettingError("ft_frame", frame, "a link of the URDF, or empty")
    if _joint_of(model, frame) != _joint_of(model, robot.frame):
        raise SettingError("ft_frame", frame, f"a link fixed to {robot.frame!r}")
    com = values["ft_tool_com"]
    if len(com) not in (0, 3) or not np.isfinite(com).all():
        raise SettingError("ft_tool_com", com, "three finite numbers, or none")
    if values["ft_tool_mass"] == -1.0:
        try:
            tool = inertia_beyond(urdf, frame, locked_joints(values))
        except RobotDescriptionError as error:
            raise SettingError("ft_frame", frame, f"a link of the URDF ({error})") from error
    else:
        mass = positive(values, "ft_tool_mass", zero=True)
        tool = pin.Inertia(mass, com if len(com) else np.zeros(3), np.zeros((3, 3)))
    placement = _between(model, robot.frame, frame)
    return WrenchSensor(placement, tool, model.gravity.linear, sensor_settings(values))


def _contact_frames(values: Mapping[str, Any]) -> list[str]:
    """Return the links in contact, each once; several points of one link are one contact."""
    return list(dict.fromkeys(values["contact_frames"]))


def _contacts(values: Mapping[str, Any], model: pin.Model) -> Contacts | None:
    named = values["contact_frames"]
    if not named:
        return None
    points = _triples(values, "contact_points", named, optional=True)
    normals = _triples(values, "contact_normals", named)
    if not (np.abs(normals).max(axis=1) > 1e-9).all():
        raise SettingError("contact_normals", values["contact_normals"], "directions, not zero")
    friction = values["contact_friction"]
    if not len(friction):
        friction = np.zeros(len(named))
    if len(friction) != len(named) or not (np.isfinite(friction) & (friction >= 0.0)).all():
        raise SettingError("contact_friction", friction, f"{len(named)} finite numbers >= 0")
    contacts = []
    for frame in _contact_frames(values):
        if not model.existFrame(frame):
            raise SettingError("contact_frames", list(named), f"frames of the URDF, not {frame}")
        its = [i for i, name in enumerate(named) if name == frame]
        first = its[0]
        for i in its:
            if friction[i] != friction[first] or not np.array_equal(normals[i], normals[first]):
                allowed = f"the same friction and normal at all points of {frame!r}"
                raise SettingError("contact_normals", values["contact_normals"], allowed)
        contacts.append(FrictionContact(frame, points[its], normals[first], friction[first]))
    return Contacts(model, contacts)


def _triples(
    values: Mapping[str, Any], name: str, frames: Sequence[str], *, optional: bool = False
) -> np.ndarray:
    value = values[name]
    if optional and not len(value):
        return np.zeros((len(frames), 3))
    if len(value) != 3 * len(frames) or not np.isfinite(value).all():
        allowed = f"{3 * len(frames)} finite numbers, three for each of 'contact_frames'"
        raise SettingError(name, value, allowed)
    return value.reshape(-1, 3)


def _joint_of(model: pin.Model, frame: str) -> int:
    return model.frames[model.getFrameId(frame)].parentJoint


def _between(model: pin.Model, frame: str, other: str) -> pin.SE3:
    """Return the placement of a frame in another that is fixed to the same joint."""
    first, second = (model.frames[model.getFrameId(name)].placement for name in (frame, other))
    return first.actInv(second)
