# SPDX-License-Identifier: Apache-2.0
"""The collision geometry of a URDF as triangles of links."""

from __future__ import annotations

from itertools import combinations, product
from typing import NamedTuple

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from torque_safety_controller.collision.capsule_fit import Capsule
from viability_bounds_pkg.robot_description import RobotDescriptionError

Array = NDArray[np.float64]

_SIDES = 16  # of the prism around a cylinder


class LinkShape(NamedTuple):
    """Collision geometry of a link, in the axes of the joint that moves it.

    Attributes:
        link: its name.
        joint: index of the joint in the reduced model; 0 for links fixed to the base.
        vertices: of its meshes, boxes and cylinders, shape (m, 3), m.
        triangles: indices of these, shape (k, 3).
        capsules: its spheres and capsules.
    """

    link: str
    joint: int
    vertices: Array
    triangles: NDArray[np.int64]
    capsules: list[Capsule]


def link_shapes(model: pin.Model, geometry: pin.GeometryModel) -> list[LinkShape]:
    """Return the shapes of all links that have any, base to tip.

    Args:
        model: with the joints that the geometry hangs on.
        geometry: of `robot_description.load_geometry`.

    Raises:
        RobotDescriptionError: a kind of geometry that a URDF does not have.
    """
    shapes: dict[str, LinkShape] = {}
    for item in geometry.geometryObjects:
        link, place, geom = model.frames[item.parentFrame].name, item.placement, item.geometry
        shape = shapes.setdefault(
            link,
            LinkShape(
                link, item.parentJoint, np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64), []
            ),
        )
        if isinstance(geom, coal.Sphere | coal.Capsule):
            half = getattr(geom, "halfLength", 0.0) * place.rotation[:, 2]
            centre = place.translation
            shape.capsules.append(Capsule(centre - half, centre + half, geom.radius))
            continue
        vertices, triangles = _mesh(item)
        vertices = vertices @ place.rotation.T + place.translation
        shapes[link] = shape._replace(
            vertices=np.vstack([shape.vertices, vertices]),
            triangles=np.vstack([shape.triangles, triangles + len(shape.vertices)]),
        )
    return sorted(shapes.values(), key=lambda shape: shape.joint)


def _mesh(item: pin.GeometryObject) -> tuple[Array, NDArray[np.int64]]:
    """Return vertices and triangles of a mesh, a box or a cylinder in its own axes."""
    shape = item.geometry
    if isinstance(shape, coal.BVHModelBase):
        indices = map(shape.tri_indices, range(shape.num_tris))
        triangles = [(t[0], t[1], t[2]) for t in indices]  # it does not say where it ends
        return np.array(shape.vertices()), np.array(triangles, dtype=np.int64)
    if isinstance(shape, coal.Box):
        corners = np.array(list(product((-1.0, 1.0), repeat=3))) * shape.halfSide
    elif isinstance(shape, coal.Cylinder):
        angle = 2.0 * np.pi * np.arange(_SIDES) / _SIDES
        radius = shape.radius / np.cos(np.pi / _SIDES)  # the prism is outside
        ring = radius * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
        lift = np.array([0.0, 0.0, shape.halfLength])
        corners = np.vstack([ring - lift, ring + lift])
    else:
        raise RobotDescriptionError(
            f"{item.name}: collision geometry {type(shape).__name__} is not among "
            "mesh, box, cylinder, capsule and sphere"
        )
    # All triangles between corners: the faces are among them, and none is outside.
    return corners, np.array(list(combinations(range(len(corners)), 3)), dtype=np.int64)
