# SPDX-License-Identifier: Apache-2.0
"""Smallest capsules around the links of a URDF, fitted to its collision geometry.

A capsule is convex, so that it holds a mesh when it holds its vertices.
"""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from viability_bounds_pkg.robot.files import RobotDescriptionError

Array = NDArray[np.float64]

_ROUNDS = 24
_CANDIDATES = 48
_EXTREMES = 96  # directions in which vertices are sought that decide the fit
_SMALLEST = 1e-4  # m; radius of the capsule around a point
_SIDES = 16  # of the prism around a cylinder
_ROUNDED = 4  # digits, of metres
_ROUNDING = 1e-11  # m; what the squares of distances lack


class Capsule(NamedTuple):
    """All points within `radius` of a segment.

    Attributes:
        start: one end of the segment, shape (3,), m.
        end: the other end, shape (3,), m; the same for a sphere.
        radius: m.
    """

    start: Array
    end: Array
    radius: float


def fitted_capsule(points: Array) -> Capsule:
    """Return a small capsule around points, shape (m, 3), m.

    A random search over axes from the points' principal ones; the same points give the same one.
    """
    rng = np.random.default_rng(0)
    extremes = _extremes(points)
    centred = extremes - extremes.mean(axis=0)
    axes = np.linalg.svd(centred, full_matrices=len(extremes) < 3)[2]  # principal ones
    along = extremes @ axes.T
    middle = 0.5 * (along.max(axis=0) + along.min(axis=0)) @ axes
    scale = max(float(np.abs(extremes - points.mean(axis=0)).max()), _SMALLEST)
    volumes = _volumes(extremes, axes, middle[None])
    best = int(np.argmin(volumes))
    axis, origin, volume = axes[best], middle, volumes[best]
    for k in range(_ROUNDS):
        reach = 0.3 * 0.03 ** (k / _ROUNDS)
        turned = axis + reach * rng.normal(size=(_CANDIDATES, 3))
        turned /= np.linalg.norm(turned, axis=1)[:, None]
        moved = origin + reach * scale * rng.normal(size=(_CANDIDATES, 3))
        volumes = _volumes(extremes, turned, moved)
        best = int(np.argmin(volumes))
        if volumes[best] < volume:
            axis, origin, volume = turned[best], moved[best], volumes[best]
    return _capsule_along(points, axis, origin)


def _extremes(points: Array) -> Array:
    """Return the points furthest out in directions spread over the sphere."""
    k = np.arange(_EXTREMES) + 0.5
    height, angle = 1.0 - 2.0 * k / _EXTREMES, np.pi * (1.0 + 5.0**0.5) * k
    ring = np.sqrt(1.0 - height**2)
    directions = np.stack([ring * np.cos(angle), ring * np.sin(angle), height])
    furthest: Array = points[np.unique(np.argmax(points @ directions, axis=0))]
    return furthest


def _volumes(points: Array, axes: Array, origins: Array) -> Array:
    """Return the volumes of the capsules along lines, given by axes and origins as rows."""
    along, across2 = _coordinates(points, axes, origins)
    square = across2.max(axis=1)
    cap = np.sqrt(square[:, None] - across2)
    length = ((along - cap).max(axis=1) - (along + cap).min(axis=1)).clip(0.0)
    volumes: Array = np.pi * square * (length + 4.0 / 3.0 * np.sqrt(square))
    return volumes


def _capsule_along(points: Array, axis: Array, origin: Array) -> Capsule:
    """Return the smallest capsule around points whose axis is along a line."""
    along, across2 = _coordinates(points, axis[None], origin[None])
    radius = max(float(np.sqrt(across2.max())), _SMALLEST)
    cap = np.sqrt(np.maximum(radius**2 - across2, 0.0))
    low, high = float((along + cap).min()), float((along - cap).max())
    if low > high:
        low = high = 0.5 * (low + high)
    return Capsule(origin + low * axis, origin + high * axis, radius + _ROUNDING)


def _coordinates(points: Array, axes: Array, origins: Array) -> tuple[Array, Array]:
    """Return positions along lines and squared distances from them, shape (lines, points)."""
    along = axes @ points.T - np.sum(axes * origins, axis=1)[:, None]
    squared = np.sum(points**2, axis=1)[None] - 2.0 * origins @ points.T
    squared += np.sum(origins**2, axis=1)[:, None]
    return along, np.maximum(squared - along**2, 0.0)


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
