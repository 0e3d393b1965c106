# SPDX-License-Identifier: Apache-2.0
"""What of a robot is to be seen: the visual geometry of its URDF as triangles."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import coal
import numpy as np
import pinocchio as pin
import trimesh
from numpy.typing import NDArray

from viability_bounds_pkg.robot.description import load_geometry

Array = NDArray[np.float64]


class VisualShape(NamedTuple):
    """A shape of a link, in the axes of the joint that moves it."""

    joint: int
    """Index of the joint in the reduced model; 0 for what does not move."""
    vertices: Array
    """Shape (m, 3), m."""
    triangles: NDArray[np.int64]
    """Indices of vertices, shape (k, 3)."""


def visual_shapes(
    urdf: str, model: pin.Model, locked_positions: Mapping[str, float]
) -> list[VisualShape]:
    """Return all that can be seen of a robot.

    Args:
        urdf: text of the URDF.
        model: made of it by `build_model`, other joints locked.
        locked_positions: as given to it, rad.

    Raises:
        RobotDescriptionError: a mesh cannot be found or loaded.
    """
    geometry = load_geometry(urdf, model, locked_positions, "visual")
    shapes = []
    for item in geometry.geometryObjects:
        vertices, triangles = _mesh(item.geometry)
        place = item.placement
        vertices = (vertices * item.meshScale) @ place.rotation.T + place.translation
        shapes.append(VisualShape(item.parentJoint, vertices, triangles))
    return shapes


def _mesh(shape: coal.CollisionGeometry) -> tuple[Array, NDArray[np.int64]]:
    """Return vertices and triangles of a shape in its own axes; none of an unknown kind."""
    if isinstance(shape, coal.BVHModelBase):
        indices = map(shape.tri_indices, range(shape.num_tris))
        triangles = [(t[0], t[1], t[2]) for t in indices]  # it does not say where it ends
        return np.array(shape.vertices()), np.array(triangles, dtype=np.int64)
    if isinstance(shape, coal.Box):
        mesh = trimesh.creation.box(2.0 * np.asarray(shape.halfSide))
    elif isinstance(shape, coal.Cylinder):
        mesh = trimesh.creation.cylinder(shape.radius, 2.0 * shape.halfLength)
    elif isinstance(shape, coal.Capsule):
        mesh = trimesh.creation.capsule(2.0 * shape.halfLength, shape.radius)
        mesh.apply_translation([0.0, 0.0, -mesh.bounds.mean(axis=0)[2]])
    elif isinstance(shape, coal.Sphere):
        mesh = trimesh.creation.icosphere(subdivisions=2, radius=shape.radius)
    else:
        return np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64)
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)
