# SPDX-License-Identifier: Apache-2.0
"""Capsules around the links of a URDF, fitted to its collision geometry."""

from __future__ import annotations

from itertools import product

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from torque_safety_controller.tools.capsule_fit import Capsule, fitted_capsule
from viability_bounds_pkg.robot.description import RobotDescriptionError

Array = NDArray[np.float64]

_SIDES = 16  # of the prism around a cylinder
_ROUNDED = 4  # digits, of metres


def capsule_entries(model: pin.Model, geometry: pin.GeometryModel) -> list[str]:
    """Return the entries of the parameter ``collision_capsules``, base to tip.

    Numbers are rounded to 0.1 mm, radii by as much larger.

    Args:
        model: with the joints that the geometry hangs on.
        geometry: of `load_geometry`.

    Raises:
        RobotDescriptionError: a kind of geometry that a URDF does not have.
    """
    step = 10.0**-_ROUNDED
    entries = []
    for link, capsules in link_capsules(model, geometry).items():
        for start, end, radius in capsules:
            ends = [np.round(point, _ROUNDED) + 0.0 for point in (start, end)]
            # Ends move by less than a step.
            radius = np.ceil(radius / step + 1.0) * step
            a, b = (", ".join(f"{x:.{_ROUNDED}f}" for x in point) for point in ends)
            sizes = f"start: [{a}], end: [{b}], radius: {radius:.{_ROUNDED}f}"
            entries.append(f"{{link: {link}, {sizes}}}")
    return entries


def link_capsules(model: pin.Model, geometry: pin.GeometryModel) -> dict[str, list[Capsule]]:
    """Return the capsules of each link, in its frame, base to tip; see `capsule_entries`.

    One is around its meshes, boxes and cylinders; others are its own capsules and spheres.
    """
    points: dict[str, list[Array]] = {}
    capsules: dict[str, list[Capsule]] = {}
    for item in sorted(geometry.geometryObjects, key=lambda item: item.parentJoint):
        frame, shape = model.frames[item.parentFrame], item.geometry
        place = frame.placement.actInv(item.placement)
        own = capsules.setdefault(frame.name, [])
        if isinstance(shape, coal.Sphere | coal.Capsule):
            half = np.array([0.0, 0.0, getattr(shape, "halfLength", 0.0)])
            own.append(Capsule(place.act(-half), place.act(half), shape.radius))
        else:
            vertices = _vertices(shape) @ place.rotation.T + place.translation
            points.setdefault(frame.name, []).append(vertices)
    for link, parts in points.items():
        capsules[link].append(fitted_capsule(np.vstack(parts)))
    return capsules


def _vertices(shape: coal.CollisionGeometry) -> Array:
    """Return points in its own axes, shape (m, 3), m, whose convex hull holds a shape."""
    if isinstance(shape, coal.BVHModelBase):
        return np.array(shape.vertices())
    if isinstance(shape, coal.Box):
        return np.array(list(product((-1.0, 1.0), repeat=3))) * shape.halfSide
    if isinstance(shape, coal.Cylinder):
        angle = 2.0 * np.pi * np.arange(_SIDES) / _SIDES
        radius = shape.radius / np.cos(np.pi / _SIDES)  # the prism is outside
        ring = radius * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
        lift = np.array([0.0, 0.0, shape.halfLength])
        return np.vstack([ring - lift, ring + lift])
    raise RobotDescriptionError(
        f"collision geometry {type(shape).__name__} is not among mesh, box, cylinder, capsule and "
        "sphere"
    )
