# SPDX-License-Identifier: Apache-2.0
"""Obstacles, their material, and the forces and contacts between them and a robot."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sim_bridge.bullet.vectors import finite_vector
from viability_bounds_pkg.exceptions import ArmSafetyError
from viability_bounds_pkg.parameter import Range, above, check, number

Array = NDArray[np.float64]

SHAPES = ("box", "sphere", "cylinder")
_ROUND = {"sphere": (0, 1, 2), "cylinder": (0, 1)}  # axes along which the sizes are equal
_SIZE_MIN, _SIZE_MAX = 1e-3, 1e3  # m; beyond them PyBullet's collision detection is wrong


class ObstacleError(ArmSafetyError, ValueError):
    """An obstacle with invalid properties, or one that overlaps the robot."""


class Obstacle:
    """A fixed solid in the world of a robot.

    Args:
        name: identifies it; not empty.
        shape: box, sphere or cylinder, the last along its z axis.
        size: lengths or diameters along its own axes, as the `scale` of an RViz marker, shape
            (3,), m, from 1 mm to 1 km; equal along the axes of a circular section.
        position: of its centre in the frame of the robot's root link, shape (3,), m.
        orientation: in that frame, quaternion x, y, z, w, shape (4,), of any length but zero; it
            is stored with length one.

    Raises:
        ObstacleError: one of them is invalid.
    """

    def __init__(
        self,
        name: str,
        shape: str,
        size: ArrayLike,
        position: ArrayLike,
        orientation: ArrayLike = (0.0, 0.0, 0.0, 1.0),
    ) -> None:
        if not name:
            raise ObstacleError("an obstacle needs a name")
        self.name, self.shape = name, shape
        if shape not in SHAPES:
            raise self._error(f"its shape is {shape!r}, none of {', '.join(SHAPES)}")
        try:
            self.size = finite_vector("size", size, 3)
            self.position = finite_vector("position", position, 3)
            self.orientation = finite_vector("orientation", orientation, 4)
        except (ValueError, TypeError) as error:
            raise self._error(str(error)) from error
        if np.any(self.size < _SIZE_MIN) or np.any(self.size > _SIZE_MAX):
            raise self._error(f"its size is {self.size.tolist()} m, not 1 mm to 1 km")
        if len({float(self.size[axis]) for axis in _ROUND.get(shape, ())}) > 1:
            raise self._error(f"a {shape} is round, not {self.size.tolist()} m")
        length = math.hypot(*self.orientation)
        if not (1e-6 < length < 1e6):
            raise self._error(f"its orientation {self.orientation.tolist()} is no quaternion")
        self.orientation = self.orientation / length

    def _error(self, reason: str) -> ObstacleError:
        return ObstacleError(f"obstacle {self.name!r}: {reason}")


class LinkWrench(NamedTuple):
    """An external wrench on a link of the robot, in world axes."""

    link: str
    point: Array | None  # where the force acts, shape (3,), m; None: the link's origin
    force: Array  # shape (3,), N
    torque: Array = np.zeros(3)  # shape (3,), N m


class Contact(NamedTuple):
    """A contact point between robot and obstacle, in the frame of the robot's root link."""

    link: str  # the first of those that move as one with the touching one
    obstacle: str
    position: Array  # of the point on the robot, shape (3,), m
    normal: Array  # from the obstacle to the robot, shape (3,)
    force: Array  # of the obstacle on the robot, shape (3,), N


@dataclass(frozen=True)
class ContactMaterial:
    """Friction, stiffness and damping of obstacles; each obstacle moves as a whole.

    Raises:
        SettingError: a value is out of range; named as the node's parameters.
    """

    friction: float = number(
        "Coulomb's coefficient between robot and obstacles", Range(0.0, 10.0), default=0.5
    )
    stiffness: float = number(
        "stiffness of obstacles, N/m; 2e5: 0.5 mm at 100 N", above(0.0, 1e9), default=2e5
    )
    damping: float = number("damping of obstacles, N s/m", Range(0.0, 1e9), default=600.0)

    def __post_init__(self) -> None:
        """Check the values."""
        check(self, "obstacle_")
