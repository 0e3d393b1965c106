# SPDX-License-Identifier: Apache-2.0
"""Parameters of the collision avoidance."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from torque_safety_controller.parameters.entries import read_entries
from torque_safety_controller.parts.collision.avoidance import CollisionSettings
from torque_safety_controller.parts.collision.shapes import SHAPES, Shape, capsule, make_obstacle
from viability_bounds_pkg.exceptions import SettingError
from viability_bounds_pkg.parameter import (
    FINITE,
    NEGATIVE,
    POSITIVE,
    check_per_joint,
    group,
    joint_numbers,
    number,
    numbers,
    switch,
    text,
    texts,
)
from viability_bounds_pkg.robot.configuration import RobotConfiguration

Array = NDArray[np.float64]

_EQUAL = {"cylinder": 2, "sphere": 3}  # of the numbers of a size, how many are one diameter


@dataclass(frozen=True, eq=False, kw_only=True)
class ObstacleEntry:
    """One entry of ``obstacles``."""

    name: str = text("what no other obstacle is called")
    shape: str = text("what it is", choices=SHAPES)
    size: Array = numbers("as in a Marker, m", POSITIVE, length=3, default=())
    position: Array = numbers("of its centre, m", FINITE, length=3)
    rpy: Array = numbers("about the axes x, y, z, rad", FINITE, length=3, default=(0.0, 0.0, 0.0))


@dataclass(frozen=True, eq=False, kw_only=True)
class CapsuleEntry:
    """One entry of ``collision_capsules``."""

    link: str = text("link that it is around")
    start: Array = numbers("one end of its axis in the link's frame, m", FINITE, length=3)
    end: Array = numbers("other end, m", FINITE, length=3)
    radius: float = number("distance from the axis, m", POSITIVE)


@dataclass(frozen=True, eq=False, kw_only=True)
class CollisionConfiguration:
    """Parameters of the collision avoidance; arrays of shape (n,) in `joints` order.

    Attributes:
        capsules: around the links, in their frames.
        bodies: the obstacles, in the base frame.
        pairs: of links to keep apart; None to choose them automatically.
    """

    collision_avoidance: bool = switch(
        "whether links keep away from each other and from the obstacles below", default=False
    )
    settings: CollisionSettings = group(CollisionSettings, "collision_")
    collision_capsules: tuple[str, ...] = texts(
        "capsules around the links, which are kept apart in place of these, from the tool "
        "fit_capsules: ends of the axis in the link's frame and radius, m",
        default=(),
        note="each a YAML mapping '{link: hand, start: [x, y, z], end: [x, y, z], radius: r}'",
    )
    collision_pairs: tuple[str, ...] = texts(
        "pairs of links to keep apart; chosen automatically if empty",
        default=(),
        note="each two links, as in 'link_a link_b'",
    )
    acceleration_min: Array = joint_numbers(
        "for collision_avoidance, safety_filter, and HOLD without bounds: lower acceleration "
        "limits, rad/s^2",
        NEGATIVE,
        default=(),
    )
    acceleration_max: Array = joint_numbers(
        "for collision_avoidance, safety_filter, and HOLD without bounds: upper acceleration "
        "limits, rad/s^2",
        POSITIVE,
        default=(),
    )
    obstacles: tuple[str, ...] = texts(
        "obstacles to keep away from, fixed in base_frame: position of the centre, of a "
        "half_space a point on its surface, m; rpy, rotations about the fixed axes x, y, z, rad, "
        "0 if left out, a half_space is where z < 0; size, m, as in a Marker: edges of a box, "
        "diameter three times of a sphere, diameter, diameter and height along z of a cylinder, "
        "nothing of a half_space",
        default=(),
        note="each a YAML mapping '{name: wall, shape: box, size: [x, y, z], position: "
        f"[x, y, z], rpy: [r, p, y]}}' with another name; shape is one of {', '.join(SHAPES)}",
    )
    capsules: tuple[Shape, ...] = field(init=False)
    bodies: tuple[Shape, ...] = field(init=False)
    pairs: tuple[tuple[str, str], ...] | None = field(init=False)

    def __post_init__(self) -> None:
        """Read capsules, obstacles and pairs."""
        entries = read_entries(CapsuleEntry, "collision_capsules", self.collision_capsules)
        capsules = [capsule(each.link, each.start, each.end, each.radius) for each in entries]
        object.__setattr__(self, "capsules", tuple(capsules))
        object.__setattr__(self, "bodies", _obstacles(self.obstacles))
        object.__setattr__(self, "pairs", tuple(map(_pair, self.collision_pairs)) or None)

    def check(self, robot: RobotConfiguration) -> None:
        """Check what depends on the robot.

        Raises:
            SettingError: no limits of acceleration.
        """
        if self.collision_avoidance:
            self.check_accelerations(robot)

    def check_accelerations(self, robot: RobotConfiguration) -> None:
        """Check that there are acceleration limits.

        Raises:
            SettingError: none.
        """
        check_per_joint("acceleration_min", self.acceleration_min, robot.joints)
        check_per_joint("acceleration_max", self.acceleration_max, robot.joints)


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
        if len(set(size[: _EQUAL.get(entry.shape, 1)])) > 1:
            allowed = f"the same diameter {_EQUAL[entry.shape]} times"
            raise SettingError(f"{label}.size", size, allowed)
        orientation = pin.Quaternion(pin.rpy.rpyToMatrix(entry.rpy)).coeffs()
        obstacles[name] = make_obstacle(name, entry.shape, size, entry.position, orientation)
    return tuple(obstacles.values())


def _pair(text: str) -> tuple[str, str]:
    links = text.split()
    if len(links) != 2:
        raise SettingError("collision_pairs", text, "two links, as in 'link_a link_b'")
    return links[0], links[1]
