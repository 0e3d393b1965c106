"""Obstacles that the arm must keep away from, fixed in its base frame."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

from viability_bounds_pkg.exceptions import ArmSafetyError


class CollisionError(ArmSafetyError, ValueError):
    """An obstacle, a pair or a setting of the collision avoidance that cannot be used.

    Args:
        field: which of them.
        value: what was given.
        allowed: what would have been accepted.
        obstacle: its name, if it is about one.
    """

    def __init__(self, field: str, value: object, allowed: str, obstacle: str = "") -> None:
        self.field = field
        self.value = value
        self.allowed = f"{allowed} (obstacle {obstacle!r})" if obstacle else allowed
        super().__init__(f"{field} = {value}: must be {self.allowed}")


@dataclass(frozen=True, eq=False)
class Obstacle:
    """Something that stands still; made by the functions below.

    Attributes:
        name: different from all others and from the links.
        kind: ``capsule``, ``box`` or ``half_space``.
        placement: of the shape in the base frame.
        size: capsule: half the length of its axis (z), m, and radius, m; box: half its edges,
            shape (3,), m; half space: empty, the solid is where z < 0.
    """

    name: str
    kind: str
    placement: pin.SE3
    size: NDArray[np.float64]


SHAPES = ("box", "sphere", "cylinder", "half_space")
"""Shapes of `make_obstacle`."""


def make_obstacle(
    name: str, shape: str, size: ArrayLike, position: ArrayLike, orientation: ArrayLike
) -> Obstacle:
    """Return an obstacle described as a `visualization_msgs/Marker` is.

    Args:
        name: of the obstacle.
        shape: one of `SHAPES`. A cylinder is kept as the capsule around it, which is longer by
            its radius at either end.
        size: full lengths along the obstacle's axes, shape (3,), m: edges of a box, diameters
            of a sphere, diameter, diameter and height of a cylinder; nothing of a half space.
        position: of its centre, or of a point on the surface of a half space, shape (3,), m.
        orientation: quaternion x, y, z, w of its axes, normalised here; a half space is where
            z < 0.

    Raises:
        CollisionError: something of it cannot be.
    """
    if shape not in SHAPES:
        raise CollisionError("shape", shape, f"one of {', '.join(SHAPES)}", name)
    rotation = _rotation(name, orientation)
    centre = _vector(name, "position", position)
    if shape == "half_space":
        return half_space(name, centre, rotation[:, 2])
    if shape == "box":
        return box(name, centre, size, orientation)
    diameter, other, height = lengths = _vector(name, "size", size)
    if diameter != other or (shape == "sphere" and diameter != height) or not (lengths > 0).all():
        equal = "three times" if shape == "sphere" else "twice"
        raise CollisionError("size", size, f"a positive diameter {equal}", name)
    if shape == "sphere":
        return sphere(name, centre, 0.5 * diameter)
    half = 0.5 * height * rotation[:, 2]
    return capsule(name, centre - half, centre + half, 0.5 * diameter)


def sphere(name: str, centre: ArrayLike, radius: float) -> Obstacle:
    """Return a sphere; `centre` of shape (3,) and `radius` in m."""
    return capsule(name, centre, centre, radius)


def capsule(name: str, start: ArrayLike, end: ArrayLike, radius: float) -> Obstacle:
    """Return all points within `radius` of the segment between two points of shape (3,), m.

    A pole is one, too: it is longer by a radius at each end than the cylinder.
    """
    a, b = _vector(name, "start", start), _vector(name, "end", end)
    radius = _positive(name, "radius", radius)
    length = float(np.linalg.norm(b - a))
    axis = (b - a) / length if length > 0.0 else np.array([0.0, 0.0, 1.0])
    placement = pin.SE3(_rotation_to(axis), 0.5 * (a + b))
    return Obstacle(_name(name), "capsule", placement, np.array([0.5 * length, radius]))


def box(
    name: str, centre: ArrayLike, size: ArrayLike, orientation: ArrayLike = (0.0, 0.0, 0.0, 1.0)
) -> Obstacle:
    """Return a box.

    Args:
        name: of the obstacle.
        centre: shape (3,), m.
        size: lengths of its edges, shape (3,), m.
        orientation: quaternion x, y, z, w of its axes, normalised here.

    Raises:
        CollisionError: sizes that are not positive, or numbers that are not finite.
    """
    half = 0.5 * _vector(name, "size", size)
    if not (half > 0.0).all():
        raise CollisionError("size", size, "positive", name)
    placement = pin.SE3(_rotation(name, orientation), _vector(name, "centre", centre))
    return Obstacle(_name(name), "box", placement, half)


def half_space(name: str, point: ArrayLike, normal: ArrayLike) -> Obstacle:
    """Return everything behind a plane.

    Args:
        name: of the obstacle.
        point: on the plane, shape (3,), m.
        normal: out of the solid, shape (3,), of any length but zero.

    Raises:
        CollisionError: a normal of zero, or numbers that are not finite.
    """
    direction = _vector(name, "normal", normal)
    length = float(np.linalg.norm(direction))
    if length < 1e-9:
        raise CollisionError("normal", normal, "a direction, not zero", name)
    placement = pin.SE3(_rotation_to(direction / length), _vector(name, "point", point))
    return Obstacle(_name(name), "half_space", placement, np.zeros(0))


def _rotation(name: str, orientation: ArrayLike) -> np.ndarray:
    """Return the rotation of a quaternion x, y, z, w."""
    quaternion = _vector(name, "orientation", orientation, 4)
    norm = float(np.linalg.norm(quaternion))
    if norm < 1e-6:
        raise CollisionError("orientation", orientation, "a quaternion, not zero", name)
    return pin.Quaternion(quaternion / norm).toRotationMatrix()


def _rotation_to(axis: np.ndarray) -> np.ndarray:
    """Return a rotation whose z axis is `axis`, a unit vector."""
    side = np.eye(3)[int(np.argmin(np.abs(axis)))]
    x = np.cross(side, axis)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(axis, x), axis], axis=1)


def _name(name: str) -> str:
    if not isinstance(name, str) or not name:
        raise CollisionError("name", repr(name), "a non-empty string")
    return name


def _vector(name: str, field: str, values: ArrayLike, n: int = 3) -> np.ndarray:
    try:
        array = np.array(values, dtype=float)
    except (TypeError, ValueError):
        array = np.zeros(0)
    if array.shape != (n,) or not np.isfinite(array).all():
        raise CollisionError(field, values, f"{n} finite numbers", name)
    return array


def _positive(name: str, field: str, value: float) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = math.nan
    if not (math.isfinite(number) and number > 0.0):
        raise CollisionError(field, value, "a finite number > 0", name)
    return number
