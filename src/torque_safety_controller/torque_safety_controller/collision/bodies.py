# SPDX-License-Identifier: Apache-2.0
"""Shapes that are kept apart: obstacles, fixed in the base frame, and capsules around links."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

from viability_bounds_pkg.exceptions import SettingError

Array = NDArray[np.float64]

SHAPES = ("box", "sphere", "cylinder", "half_space")
"""Shapes of `make_obstacle`."""

_UPRIGHT = (0.0, 0.0, 0.0, 1.0)
_LARGE = 1e3  # m; half the edges of the box that stands for a half space


@dataclass(frozen=True, eq=False)
class CollisionBody:
    """A box with rounded edges: an obstacle, or a capsule around a link.

    Attributes:
        name: of the obstacle, different from all others and from the links; or of the link.
        placement: of the box in the base frame, or in the axes of the joint that moves it.
        half: half its edges, shape (3,), m; those of a sphere are 0, those of a capsule but z.
        radius: of the rounding, m.
        plane: whether it stands for a half space.
        joint: index of the joint that moves it; 0 for what does not move.
    """

    name: str
    placement: pin.SE3
    half: Array
    radius: float = 0.0
    plane: bool = False
    joint: int = 0

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not self.name:
            raise SettingError("name of an obstacle", self.name, "a non-empty string")
        if not (self.half >= 0.0).all() or not (self.half.all() or self.radius > 0.0):
            sizes = [*(2.0 * self.half), self.radius]
            raise SettingError(f"sizes of obstacle {self.name!r}", sizes, "positive lengths")


def make_obstacle(
    name: str, shape: str, size: ArrayLike, position: ArrayLike, orientation: ArrayLike
) -> CollisionBody:
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
        SettingError: a value cannot be used.
    """
    centre, rotation = _vector(name, "position", position), _rotation(name, orientation)
    if shape == "half_space":
        return half_space(name, centre, rotation[:, 2])
    if shape == "box":
        return box(name, centre, size, orientation)
    diameter, _, height = _vector(name, "size", size)
    half = 0.5 * height * rotation[:, 2] if shape == "cylinder" else np.zeros(3)
    return capsule(name, centre - half, centre + half, 0.5 * diameter)


def sphere(name: str, centre: ArrayLike, radius: float) -> CollisionBody:
    """Return a sphere; `centre` of shape (3,) and `radius` in m."""
    return capsule(name, centre, centre, radius)


def capsule(name: str, start: ArrayLike, end: ArrayLike, radius: float) -> CollisionBody:
    """Return all points within `radius` of the segment between two points of shape (3,), m."""
    a, b = _vector(name, "start", start), _vector(name, "end", end)
    (radius,) = _vector(name, "radius", [radius], 1)
    half = np.array([0.0, 0.0, 0.5 * np.linalg.norm(b - a)])
    return CollisionBody(name, pin.SE3(_rotation_to(b - a), 0.5 * (a + b)), half, radius)


def box(
    name: str, centre: ArrayLike, size: ArrayLike, orientation: ArrayLike = _UPRIGHT
) -> CollisionBody:
    """Return a box.

    Args:
        name: of the obstacle.
        centre: shape (3,), m.
        size: lengths of its edges, shape (3,), m.
        orientation: quaternion x, y, z, w of its axes, normalised here.
    """
    placement = pin.SE3(_rotation(name, orientation), _vector(name, "centre", centre))
    return CollisionBody(name, placement, 0.5 * _vector(name, "size", size))


def half_space(name: str, point: ArrayLike, normal: ArrayLike) -> CollisionBody:
    """Return everything behind a plane.

    Args:
        name: of the obstacle.
        point: on the plane, shape (3,), m.
        normal: out of the solid, shape (3,), of any length but zero.
    """
    direction = _vector(name, "normal", normal)
    if not direction.any():
        raise SettingError(f"normal of obstacle {name!r}", normal, "not zero")
    surface = pin.SE3(_rotation_to(direction), _vector(name, "point", point))
    below = pin.SE3(np.eye(3), np.array([0.0, 0.0, -_LARGE]))
    return CollisionBody(name, surface * below, np.full(3, _LARGE), plane=True)


def _rotation_to(axis: Array) -> Array:
    """Return a rotation, shape (3, 3), whose z axis is along `axis`; any for one of length 0."""
    z = np.array([0.0, 0.0, 1.0])
    turn = pin.Quaternion.FromTwoVectors(z, axis if axis.any() else z)
    return np.array(turn.toRotationMatrix())


def _rotation(name: str, orientation: ArrayLike) -> Array:
    """Return the rotation of a quaternion x, y, z, w."""
    quaternion = _vector(name, "orientation", orientation, 4)
    if np.linalg.norm(quaternion) < 1e-6:
        raise SettingError(f"orientation of obstacle {name!r}", orientation, "not zero")
    return np.array(pin.Quaternion(quaternion).normalized().toRotationMatrix())


def _vector(name: str, field: str, values: ArrayLike, n: int = 3) -> Array:
    try:
        array = np.array(values, dtype=np.float64)
    except (TypeError, ValueError):
        array = np.zeros(0)
    if array.shape != (n,) or not np.isfinite(array).all():
        raise SettingError(f"{field} of obstacle {name!r}", values, f"{n} finite numbers")
    return array
