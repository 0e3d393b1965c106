# SPDX-License-Identifier: Apache-2.0
"""Shapes that are kept apart: obstacles, fixed in the base frame, and capsules around links."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations, product

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

SHAPES = ("box", "sphere", "cylinder", "half_space")
"""Shapes of `make_obstacle`."""

_UPRIGHT = (0.0, 0.0, 0.0, 1.0)
_LARGE = 1e3  # m; half the edges of the box that stands for a half space


@dataclass(frozen=True, eq=False)
class Shape:
    """A capsule, a sphere, a box or a half space.

    Attributes:
        name: of the obstacle, or of the link that it is around.
        placement: of its middle: in the base frame; of a link's capsule, in the link's frame.
        half: half the edges of a box, shape (3,), m; of a capsule z only, of a sphere none.
        radius: of a capsule or sphere, m; 0 of a box.
        plane: whether it is a half space, a box whose upper face counts.
    """

    name: str
    placement: pin.SE3
    half: Array
    radius: float = 0.0
    plane: bool = False

    @property
    def is_box(self) -> bool:
        """Whether it is a box or a half space."""
        return self.radius == 0.0

    def ends(self, placement: pin.SE3) -> Array:
        """Return the ends of a capsule's axis, shape (2, 3), m, for a placement of its frame."""
        middle = placement * self.placement
        return np.array([middle.act(-self.half), middle.act(self.half)])

    def edges(self, placement: pin.SE3) -> Array:
        """Return a box's edges from end to end, shape (12, 2, 3), m; none of a half space."""
        if self.plane:
            return np.zeros((0, 2, 3))
        signs = np.array(list(product((-1.0, 1.0), repeat=3)))
        middle = placement * self.placement
        corners = [middle.act(each * self.half) for each in signs]
        pairs = combinations(range(8), 2)
        joined = [pair for pair in pairs if np.sum(signs[pair[0]] != signs[pair[1]]) == 1]
        return np.array([[corners[a], corners[b]] for a, b in joined])

    def geometry(self, joint: int, placement: pin.SE3) -> pin.GeometryObject:
        """Return the shape for coal.

        Args:
            joint: that moves it.
            placement: of its frame in the axes of the joint.
        """
        middle = placement * self.placement
        if self.plane:
            normal = middle.rotation[:, 2]
            surface = normal @ middle.translation + self.half[2]
            solid, middle = coal.Halfspace(normal, float(surface)), pin.SE3.Identity()
        elif self.is_box:
            solid = coal.Box(2.0 * self.half)
        else:
            solid = coal.Capsule(self.radius, 2.0 * float(self.half[2]))
        return pin.GeometryObject(self.name, joint, middle, solid)


def make_obstacle(
    name: str, shape: str, size: Array, position: Array, orientation: ArrayLike = _UPRIGHT
) -> Shape:
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
    """
    rotation = pin.Quaternion(np.array(orientation)).normalized().toRotationMatrix()
    placement = pin.SE3(rotation, np.array(position))
    if shape == "half_space":
        below = pin.SE3(np.eye(3), np.array([0.0, 0.0, -_LARGE]))
        return Shape(name, placement * below, np.full(3, _LARGE), plane=True)
    if shape == "box":
        return Shape(name, placement, 0.5 * np.array(size))
    height = 0.5 * size[2] if shape == "cylinder" else 0.0
    return Shape(name, placement, np.array([0.0, 0.0, height]), 0.5 * float(size[0]))


def capsule(name: str, start: ArrayLike, end: ArrayLike, radius: float) -> Shape:
    """Return all points within `radius` of the segment between two points of shape (3,), m."""
    a, b = np.array(start, dtype=float), np.array(end, dtype=float)
    half = 0.5 * float(np.linalg.norm(b - a))
    z = np.array([0.0, 0.0, 1.0])
    turn = pin.Quaternion.FromTwoVectors(z, b - a if half > 0.0 else z)
    placement = pin.SE3(turn.toRotationMatrix(), 0.5 * (a + b))
    return Shape(name, placement, half * z, float(radius))
