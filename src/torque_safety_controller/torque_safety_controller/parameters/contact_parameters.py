# SPDX-License-Identifier: Apache-2.0
"""Parameters of what the arm touches and must not touch: forces at the hand, collisions."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache
from typing import TypeVar

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from torque_safety_controller.parts.collision.shapes import SHAPES, Shape, capsule, make_obstacle
from torque_safety_controller.tasks.admittance import InteractionSettings
from viability_bounds_pkg.exceptions import SettingError, did_you_mean
from viability_bounds_pkg.parameter import (
    FINITE,
    NEGATIVE,
    NOT_NEGATIVE,
    POSITIVE,
    Range,
    above,
    group,
    joint_numbers,
    number,
    numbers,
    parameter_table,
    read,
    switch,
    text,
    texts,
)
from viability_bounds_pkg.parameter_files import YamlError, load_yaml
from viability_bounds_pkg.robot.configuration import RobotConfiguration

Entry = TypeVar("Entry")


@lru_cache(maxsize=16)  # other parameters change while a control loop waits
def read_entries(kind: type[Entry], parameter: str, entries: tuple[str, ...]) -> tuple[Entry, ...]:
    """Return what the entries of a parameter say.

    Args:
        kind: dataclass whose fields are declared as parameters.
        parameter: name of the list of strings.
        entries: YAML mappings in flow style.

    Raises:
        SettingError: an entry is no mapping, has another field, or a value is not allowed.
    """
    return tuple(_read(kind, f"{parameter}[{i}]", text) for i, text in enumerate(entries))


def _read(kind: type[Entry], label: str, text: str) -> Entry:
    fields = [row.name for row in parameter_table(kind)]
    reason = ""
    try:
        values = load_yaml(text)
    except YamlError as error:
        values, reason = None, f" ({error})"
    if not isinstance(values, dict) or not set(values) <= set(fields):
        for name in values if isinstance(values, dict) else ():
            reason = reason or ("" if name in fields else did_you_mean(str(name), fields))
        allowed = f"a YAML mapping with the fields {', '.join(fields)}{reason}"
        raise SettingError(label, text, allowed)
    try:
        return read(kind, values)
    except SettingError as error:
        raise SettingError(f"{label}.{error.name}", error.value, error.allowed) from error


Array = NDArray[np.float64]

_OF_LINK = Range(-10.0, 10.0)  # m; more are millimetres


@dataclass(frozen=True, eq=False, kw_only=True)
class ContactPoint:
    """One entry of ``contacts``."""

    frame: str = text("name of the link")
    point: Array = numbers("in its axes, m", _OF_LINK, length=3, default=(0.0, 0.0, 0.0))
    normal: Array = numbers("direction in which the environment pushes", FINITE, length=3)
    friction: float = number("Coulomb's coefficient", NOT_NEGATIVE, default=0.0)


@dataclass(frozen=True, eq=False, kw_only=True)
class InteractionConfiguration:
    """Parameters of forces.

    Attributes:
        points: of contacts.
    """

    ft_frame: str = text("link of the wrist's force/torque sensor; none if empty", default="")
    settings: InteractionSettings = group(InteractionSettings)
    contacts: tuple[str, ...] = texts(
        "points where the hand touches, all on one link: point in its axes, m; normal, the "
        "direction in which the environment pushes; Coulomb's friction",
        default=(),
        note="each a YAML mapping '{frame: link, point: [x, y, z], normal: [x, y, z], "
        "friction: 0.3}'; all have the same frame, normal and friction",
    )
    points: tuple[ContactPoint, ...] = field(init=False)

    def __post_init__(self) -> None:
        """Check all that does not depend on the URDF."""
        object.__setattr__(self, "points", _contact_points(self.contacts))
        for name in ("force_directions", "yield_threshold"):
            value = getattr(self.settings, name)
            if value.any() and not self.ft_frame:
                raise SettingError(name, value, "only with a force/torque sensor, 'ft_frame'")


def _contact_points(entries: tuple[str, ...]) -> tuple[ContactPoint, ...]:
    points = read_entries(ContactPoint, "contacts", entries)
    for index, point in enumerate(points):
        allowed = "the same at all points"
        if np.abs(point.normal).max() <= 1e-9:
            raise SettingError(f"contacts[{index}].normal", point.normal, "a direction, not zero")
        if not np.array_equal(points[0].normal, point.normal):
            raise SettingError(f"contacts[{index}].normal", point.normal, allowed)
        if points[0].friction != point.friction:
            raise SettingError(f"contacts[{index}].friction", point.friction, allowed)
    return points


_EQUAL = {"cylinder": 2, "sphere": 3}  # of the numbers of a size, how many are one diameter


@dataclass(frozen=True, eq=False, kw_only=True)
class ObstacleEntry:
    """One entry of ``obstacles``."""

    name: str = text("what no other obstacle is called")
    shape: str = text("what it is", choices=SHAPES)
    size: Array = numbers("as in a Marker, m", POSITIVE, length=3, default=())
    position: Array = numbers("of its centre, m", Range(-100.0, 100.0), length=3)
    rpy: Array = numbers("about the axes x, y, z, rad", FINITE, length=3, default=(0.0, 0.0, 0.0))


@dataclass(frozen=True, eq=False, kw_only=True)
class CapsuleEntry:
    """One entry of ``collision_capsules``."""

    link: str = text("link that it is around")
    start: Array = numbers("one end of its axis in the link's frame, m", _OF_LINK, length=3)
    end: Array = numbers("other end, m", _OF_LINK, length=3)
    radius: float = number("distance from the axis, m", above(0.0, 10.0))


@dataclass(frozen=True, eq=False, kw_only=True)
class CollisionConfiguration:
    """Parameters of the collision avoidance; arrays of shape (n,) in `joints` order.

    Attributes:
        capsules: around the links, in their frames.
        bodies: the obstacles, in the base frame.
    """

    collision_avoidance: bool = switch(
        "links keep a distance from each other and from obstacles", default=False
    )
    collision_capsules: tuple[str, ...] = texts(
        "capsules around the links, from the tool fit_capsules: ends of the axis in the link's "
        "frame, and radius, m",
        default=(),
        note="each a YAML mapping '{link: hand, start: [x, y, z], end: [x, y, z], radius: r}'",
    )
    collision_posture: Array = joint_numbers(
        "a posture free of collisions, rad: pairs nearer than 2.5 cm there are not guarded; the"
        " middle of the position limits if empty",
        default=(),
        note="within the position limits",
    )
    acceleration_min: Array = joint_numbers(
        "lower acceleration limits, rad/s^2, for collision_avoidance, safety_filter, and HOLD "
        "without bounds",
        NEGATIVE,
        default=(),
    )
    acceleration_max: Array = joint_numbers(
        "upper acceleration limits, rad/s^2, as acceleration_min",
        POSITIVE,
        default=(),
    )
    obstacles: tuple[str, ...] = texts(
        "obstacles to keep away from, fixed in base_frame, m and rad; docs/guides/collision.md "
        "explains the fields",
        default=(),
        note="each a YAML mapping '{name: wall, shape: box, size: [x, y, z], position: "
        f"[x, y, z], rpy: [r, p, y]}}' with another name; shape is one of {', '.join(SHAPES)}",
    )
    capsules: tuple[Shape, ...] = field(init=False)
    bodies: tuple[Shape, ...] = field(init=False)

    def __post_init__(self) -> None:
        """Read capsules and obstacles."""
        entries = read_entries(CapsuleEntry, "collision_capsules", self.collision_capsules)
        capsules = [capsule(each.link, each.start, each.end, each.radius) for each in entries]
        object.__setattr__(self, "capsules", tuple(capsules))
        object.__setattr__(self, "bodies", _obstacles(self.obstacles))

    def posture(self, robot: RobotConfiguration) -> Array:
        """Return the posture that is free of collisions, shape (n,), rad."""
        if len(self.collision_posture):
            return self.collision_posture
        low, high = robot.position_min, robot.position_max
        limited = np.isfinite(low) & np.isfinite(high)
        return np.where(limited, 0.5 * (np.where(limited, low, 0.0) + high), 0.0)


def _obstacles(entries: tuple[str, ...]) -> tuple[Shape, ...]:
    obstacles: dict[str, Shape] = {}
    for index, entry in enumerate(read_entries(ObstacleEntry, "obstacles", entries)):
        label, name, size = f"obstacles[{index}]", entry.name, entry.size
        if not name or name in obstacles:
            raise SettingError(f"{label}.name", name, "a name that no other obstacle has")
        if entry.shape == "half_space":
            size = np.zeros(3)
        elif not len(size):
            raise SettingError(f"{label}.size", None, "3 finite numbers > 0")
        same = _EQUAL.get(entry.shape, 1)
        if (size[:same] != size[0]).any():
            raise SettingError(f"{label}.size", size, f"the same diameter {same} times")
        orientation = pin.Quaternion(pin.rpy.rpyToMatrix(entry.rpy)).coeffs()
        obstacles[name] = make_obstacle(name, entry.shape, size, entry.position, orientation)
    return tuple(obstacles.values())
