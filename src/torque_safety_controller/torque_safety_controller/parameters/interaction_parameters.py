# SPDX-License-Identifier: Apache-2.0
"""Parameters of forces at the hand and other contacts: the table, and what is made of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from torque_safety_controller.contact.admittance import AdmittanceGains
from torque_safety_controller.contact.contacts import Contacts, FrictionContact
from torque_safety_controller.contact.interaction import Interaction, InteractionSettings
from torque_safety_controller.contact.wrench_sensor import SensorSettings, WrenchSensor
from torque_safety_controller.parameters.entries import Entry
from torque_safety_controller.robot_model import RobotModel
from viability_bounds_pkg.exceptions import SettingError
from viability_bounds_pkg.robot_description import RobotDescriptionError, inertia_beyond
from viability_bounds_pkg.ros.parameters import (
    NOT_NEGATIVE,
    POSITIVE,
    Parameter,
    Range,
    above,
    given_or,
)
from viability_bounds_pkg.ros.robot_parameters import RobotConfiguration

Array = NDArray[np.float64]

_AXES = "x, y, z and about x, y, z of the end effector's axes"

_DEFAULTS = InteractionSettings()
_CONTACT_FIELDS = ("frame", "point", "normal", "friction")

INTERACTION_TABLE = (
    Parameter("ft_frame", str, "link of the wrist's force/torque sensor; none if empty", ""),
    Parameter(
        "ft_tool",
        list[float],
        "mass beyond the sensor, kg, and its centre in the sensor's axes, m; as the URDF says if "
        "empty",
        np.zeros(0),
        length=4,
        note="[mass, x, y, z] with mass >= 0",
    ),
    Parameter(
        "ft_filter_hz",
        float,
        "cut-off frequency of the wrench's filter, Hz",
        30.0,
        live=True,
        within=above(0.0, 1e4),
    ),
    Parameter(
        "ft_timeout",
        float,
        "how long without a wrench before force control ends, s",
        0.05,
        live=True,
        within=above(0.0, 60.0),
    ),
    Parameter(
        "force_directions",
        list[float],
        f"1 where target_wrench is exerted, 0 elsewhere: {_AXES}; nowhere if empty",
        np.zeros(0),
        live=True,
        length=6,
        note="zeros and ones",
    ),
    Parameter(
        "force_stiffness",
        list[float],
        f"share of pose_kp that is left there: {_AXES}; none of it if empty",
        np.zeros(0),
        live=True,
        length=6,
        within=Range(0.0, 1.0),
    ),
    Parameter(
        "admittance_kp",
        list[float],
        "gains Kp of (27) for forces, m/s^2 per N, and moments, rad/s^2 per N m",
        _DEFAULTS.gains.kp,
        live=True,
        length=2,
        within=NOT_NEGATIVE,
    ),
    Parameter(
        "admittance_speed_max",
        list[float],
        "speeds at which the hand approaches what it is to press on, m/s and rad/s",
        (0.01, 0.05),
        live=True,
        length=2,
        within=POSITIVE,
    ),
    Parameter(
        "dual_compliance",
        bool,
        "whether the hand yields to wrenches above yield_threshold, and stays where it is when "
        "they end",
        default=False,
        live=True,
    ),
    Parameter(
        "yield_threshold",
        list[float],
        "force, N, and moment, N m, above which the hand yields; it stops below half of both",
        (10.0, 2.0),
        live=True,
        length=2,
        within=POSITIVE,
    ),
    Parameter(
        "yield_kp",
        list[float],
        "acceleration by which the hand yields, m/s^2 per N and rad/s^2 per N m",
        _DEFAULTS.yielding_gains.kp,
        live=True,
        length=2,
        within=NOT_NEGATIVE,
    ),
    Parameter(
        "yield_speed_max",
        list[float],
        "speeds at which it yields at most, m/s and rad/s",
        _DEFAULTS.yielding_gains.speed_max,
        live=True,
        length=2,
        within=POSITIVE,
    ),
    Parameter(
        "contacts",
        list[str],
        "points at which the QP may use contact forces, in the axes of the link frame: point, m, "
        "its origin if left out; normal, direction in which the environment pushes; friction, "
        "Coulomb's coefficient, 0 if left out; points of one link are one contact",
        default=(),
        note="each a YAML mapping '{frame: link, point: [x, y, z], normal: [x, y, z], "
        "friction: 0.3}'; normal and friction are the same at all points of a link",
    ),
    Parameter(
        "closed_contacts",
        list[str],
        "links but the hand that are in contact at present",
        default=(),
        live=True,
        note="frames of 'contacts'",
    ),
)


class ContactPoint(NamedTuple):
    """One entry of ``contacts``.

    Attributes:
        label: of the entry, in errors.
        frame: name of the link.
        point: in its axes, shape (3,), m.
        normal: direction in which the environment pushes, shape (3,).
        friction: coefficient.
    """

    label: str
    frame: str
    point: Array
    normal: Array
    friction: float


@dataclass(frozen=True, eq=False)
class InteractionConfiguration:
    """Checked parameters of forces.

    Attributes:
        settings: what is done about forces.
        sensor: how measurements are taken.
        ft_frame: link of the sensor; empty for none.
        tool: mass beyond the sensor, kg, and its centre, m, shape (4,); None: as the URDF says.
        points: of contacts.
    """

    settings: InteractionSettings
    sensor: SensorSettings
    ft_frame: str
    tool: Array | None
    points: tuple[ContactPoint, ...]


def interaction_configuration(values: Mapping[str, Any]) -> InteractionConfiguration:
    """Check everything but what the URDF decides, which `make_interaction` needs.

    Raises:
        SettingError: a value cannot be used.
    """
    tool = values["ft_tool"] if len(values["ft_tool"]) else None
    if tool is not None and not (np.isfinite(tool).all() and tool[0] >= 0.0):
        raise SettingError("ft_tool", tool, "4 finite numbers [mass, x, y, z] with mass >= 0")
    points = _contact_points(values["contacts"])
    return InteractionConfiguration(
        settings=_settings(values, [*_by_frame(points)]),
        sensor=SensorSettings(values["ft_filter_hz"], values["ft_timeout"]),
        ft_frame=values["ft_frame"],
        tool=tool,
        points=points,
    )


def _settings(values: Mapping[str, Any], frames: Sequence[str]) -> InteractionSettings:
    for name in ("force_directions", "dual_compliance"):
        if np.any(values[name]) and not values["ft_frame"]:
            raise SettingError(name, values[name], "only with a force/torque sensor, 'ft_frame'")
    directions = given_or(values, "force_directions", np.zeros(6))
    if not np.isin(directions, (0.0, 1.0)).all():
        raise SettingError("force_directions", directions, "zeros and ones")
    for frame in values["closed_contacts"]:
        if frame not in frames:
            allowed = f"frames of 'contacts': {', '.join(frames) or 'none'}"
            raise SettingError("closed_contacts", values["closed_contacts"], allowed)
    force, moment = values["yield_threshold"]
    return InteractionSettings(
        directions=directions == 1.0,
        stiffness=given_or(values, "force_stiffness", np.zeros(6)),
        gains=_gains(values, "admittance", _DEFAULTS.gains),
        closed=tuple(frames.index(frame) for frame in values["closed_contacts"]),
        yield_threshold=(force, moment) if values["dual_compliance"] else None,
        yielding_gains=_gains(values, "yield", _DEFAULTS.yielding_gains),
    )


def _gains(values: Mapping[str, Any], prefix: str, default: AdmittanceGains) -> AdmittanceGains:
    force_kp, moment_kp = values[f"{prefix}_kp"]
    speed_max, turn_max = values[f"{prefix}_speed_max"]
    return replace(default, kp=(force_kp, moment_kp), speed_max=(speed_max, turn_max))


def _contact_points(texts: Sequence[str]) -> tuple[ContactPoint, ...]:
    points: list[ContactPoint] = []
    for index, text in enumerate(texts):
        entry = Entry("contacts", index, text, _CONTACT_FIELDS)
        frame, normal = entry.text("frame"), entry.vector("normal")
        friction = entry.number("friction", 0.0, NOT_NEGATIVE)
        if np.abs(normal).max() <= 1e-9:
            raise entry.refused("normal", "a direction, not zero")
        for other in points:
            if other.frame == frame and not np.array_equal(other.normal, normal):
                raise entry.refused("normal", f"the same at all points of {frame!r}")
            if other.frame == frame and other.friction != friction:
                raise entry.refused("friction", f"the same at all points of {frame!r}")
        point = entry.vector("point", (0.0, 0.0, 0.0))
        points.append(ContactPoint(f"contacts[{index}]", frame, point, normal, friction))
    return tuple(points)


def _by_frame(points: Sequence[ContactPoint]) -> dict[str, list[ContactPoint]]:
    """Return the points of each link; several points of one link are one contact."""
    links: dict[str, list[ContactPoint]] = {}
    for point in points:
        links.setdefault(point.frame, []).append(point)
    return links


def make_interaction(
    config: InteractionConfiguration, arm: RobotConfiguration, robot: RobotModel, urdf: str
) -> Interaction | None:
    """Return what handles forces; None where there is neither a sensor nor a contact.

    Args:
        config: of `interaction_configuration`.
        arm: which robot it is.
        robot: its model.
        urdf: text of its URDF.

    Raises:
        SettingError: a frame that the URDF does not have or that is not where it must be.
    """
    sensor = _sensor(config, arm, robot, urdf)
    contacts = _contacts(config.points, robot.model)
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
            frames = [contacts.contacts[index].frame for index in on_hand]
            raise SettingError("contacts", frames, "one link that is fixed to the hand")
        if on_hand:
            hand = on_hand[0]
            placement = _between(robot.model, robot.frame, contacts.contacts[hand].frame)
    return Interaction(sensor, contacts, hand, placement, config.settings)


def _sensor(
    config: InteractionConfiguration, arm: RobotConfiguration, robot: RobotModel, urdf: str
) -> WrenchSensor | None:
    frame, model = config.ft_frame, robot.model
    if not frame:
        return None
    if not model.existFrame(frame, pin.FrameType.BODY):
        raise SettingError("ft_frame", frame, "a link of the URDF, or empty")
    if _joint_of(model, frame) != _joint_of(model, robot.frame):
        raise SettingError("ft_frame", frame, f"a link fixed to {robot.frame!r}")
    if config.tool is not None:
        tool = pin.Inertia(config.tool[0], config.tool[1:], np.zeros((3, 3)))
    else:
        try:
            tool = inertia_beyond(urdf, frame, arm.locked)
        except RobotDescriptionError as error:
            raise SettingError("ft_frame", frame, f"a link of the URDF ({error})") from error
    placement = _between(model, robot.frame, frame)
    return WrenchSensor(placement, tool, model.gravity.linear, config.sensor)


def _contacts(points: Sequence[ContactPoint], model: pin.Model) -> Contacts | None:
    contacts = []
    for frame, its in _by_frame(points).items():
        first = its[0]
        if not model.existFrame(frame):
            raise SettingError(f"{first.label}.frame", frame, "a frame of the URDF")
        places = np.array([each.point for each in its])
        contacts.append(FrictionContact(frame, places, first.normal, first.friction))
    return Contacts(model, contacts) if contacts else None


def _joint_of(model: pin.Model, frame: str) -> int:
    return int(model.frames[model.getFrameId(frame)].parentJoint)


def _between(model: pin.Model, frame: str, other: str) -> pin.SE3:
    """Return the placement of a frame in another that is fixed to the same joint."""
    first, second = (model.frames[model.getFrameId(name)].placement for name in (frame, other))
    return first.actInv(second)
