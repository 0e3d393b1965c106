# SPDX-License-Identifier: Apache-2.0
"""What of a robot is to be seen: the visual geometry of its URDF as triangles."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import NamedTuple
from xml.etree import ElementTree

import coal
import numpy as np
import pinocchio as pin
import trimesh
from numpy.typing import NDArray

from viability_bounds_pkg.robot_description import (
    RobotDescriptionError,
    package_directories,
    resolve_uri,
)

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
        model: made of it by `robot_description.build_model`, other joints locked.
        locked_positions: as given to it, rad.

    Raises:
        RobotDescriptionError: a mesh cannot be found or loaded.
    """
    # Pinocchio's own error does not name the mesh.
    for mesh in ElementTree.fromstring(urdf).iterfind(".//visual//mesh"):
        if "://" in (name := mesh.get("filename", "")):
            resolve_uri(name)
    full = pin.buildModelFromXML(urdf)
    directories = [str(path) for path in package_directories() if path.is_dir()]
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of Pinocchio, about how it was called
            geometry = pin.buildGeomFromUrdfString(
                full, urdf, pin.GeometryType.VISUAL, directories
            )
    except (ValueError, RuntimeError) as error:
        raise RobotDescriptionError(f"visual geometry does not load: {error}") from error
    configuration = pin.neutral(full)
    for name, position in locked_positions.items():
        configuration[full.joints[full.getJointId(name)].idx_q] = position
    kept = set(model.names)
    locked = [i for i in range(1, full.njoints) if full.names[i] not in kept]
    _, (geometry,) = pin.buildReducedModel(full, [geometry], locked, configuration)
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
