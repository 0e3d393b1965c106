"""Things in the simulated world that a robot may touch, and where it touches them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from sim_bridge.bullet.vectors import finite_vector
from viability_bounds_pkg.exceptions import ArmSafetyError

SHAPES = ("box", "sphere", "cylinder")
_ROUND = {"sphere": (0, 1, 2), "cylinder": (0, 1)}  # axes along which they are equally large
_SIZE_MIN, _SIZE_MAX = 1e-3, 1e3  # m; beyond them PyBullet's collision detection is off


class ObstacleError(ArmSafetyError, ValueError):
    """An obstacle that cannot be."""


@dataclass(frozen=True, eq=False)
class Obstacle:
    """A thing that stands still, whatever pushes on it.

    Args:
        name: tells it from the others; not empty.
        shape: box, sphere or cylinder, the last along its z axis.
        size: lengths or diameters along its own axes, as the `scale` of an RViz marker, shape
            (3,), m, from 1 mm to 1 km; those of what is round must be equal.
        position: of its centre in the frame of the robot's root link, shape (3,), m.
        orientation: in that frame, quaternion x, y, z, w, shape (4,), of any length but zero; it
            is kept with length one.

    Raises:
        ObstacleError: one of them is none of this.
    """

    name: str
    shape: str
    size: np.ndarray
    position: np.ndarray
    orientation: np.ndarray = (0.0, 0.0, 0.0, 1.0)

    def __post_init__(self) -> None:
        """Check, and turn sequences into arrays."""
        if not self.name:
            raise ObstacleError("an obstacle needs a name")
        if self.shape not in SHAPES:
            raise self._error(f"its shape is {self.shape!r}, none of {', '.join(SHAPES)}")
        try:
            for field, count in (("size", 3), ("position", 3), ("orientation", 4)):
                vector = finite_vector(field, getattr(self, field), count)
                object.__setattr__(self, field, vector)
        except (ValueError, TypeError) as error:
            raise self._error(str(error)) from error
        if np.any(self.size < _SIZE_MIN) or np.any(self.size > _SIZE_MAX):
            raise self._error(f"its size is {self.size.tolist()} m, not 1 mm to 1 km")
        if len({float(self.size[axis]) for axis in _ROUND.get(self.shape, ())}) > 1:
            raise self._error(f"a {self.shape} is round, not {self.size.tolist()} m")
        length = math.hypot(*self.orientation)
        if not (1e-6 < length < 1e6):
            raise self._error(f"its orientation {self.orientation.tolist()} is no quaternion")
        object.__setattr__(self, "orientation", self.orientation / length)

    def _error(self, reason: str) -> ObstacleError:
        return ObstacleError(f"obstacle {self.name!r}: {reason}")


class Contact(NamedTuple):
    """A point where the robot touches an obstacle, in the frame of the robot's root link."""

    link: str  # of the links that move as one with the one that touches, the first
    obstacle: str
    position: np.ndarray  # of the point on the robot, shape (3,), m
    normal: np.ndarray  # from the obstacle to the robot, shape (3,)
    force: np.ndarray  # of the obstacle on the robot, shape (3,), N


@dataclass(frozen=True)
class ContactMaterial:
    """How obstacles feel.

    Args:
        friction: Coulomb's coefficient.
        stiffness: how much an obstacle as a whole resists being pressed, N/m.
        damping: the same of its speed, N s/m.

    Raises:
        ValueError: one of them is not finite, the stiffness not positive, another one negative.
    """

    friction: float = 0.5
    stiffness: float = 2e5
    damping: float = 600.0

    def __post_init__(self) -> None:
        """Check."""
        for name, low in (("friction", True), ("stiffness", False), ("damping", True)):
            value = getattr(self, name)
            if not (math.isfinite(value) and (value > 0.0 or (low and value == 0.0))):
                least = ">= 0" if low else "> 0"
                raise ValueError(f"obstacle {name} must be finite and {least}, not {value}")
