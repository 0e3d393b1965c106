"""Capsules around triangles: a few round shapes in place of a link's mesh.

A capsule is convex, so that it holds a triangle when it holds its corners. Parts of a mesh, split
by triangles, in one capsule each, are therefore covered whole, the triangles along a cut too.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_ROUNDS = 24
_CANDIDATES = 48
_EXTREMES = 96  # directions in which vertices are sought that decide the fit
_CUTS = (0.25, 0.375, 0.5, 0.625, 0.75)
_WORTH = 0.8  # a cut must leave less than this share of the volume
_SMALLEST = 1e-4  # m; radius of the capsule around a point


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

    @property
    def volume(self) -> float:
        """In m^3."""
        length = float(np.linalg.norm(self.end - self.start))
        return float(np.pi * self.radius**2 * (length + 4.0 / 3.0 * self.radius))


def capsules_around(vertices: Array, triangles: NDArray, most: int = 3) -> list[Capsule]:
    """Return up to `most` capsules that cover a mesh; more only where they are much smaller.

    Args:
        vertices: shape (m, 3), m.
        triangles: indices of vertices, shape (k, 3).
        most: number of capsules, at least 1.
    """
    parts = [(np.asarray(triangles), fitted_capsule(vertices[np.unique(triangles)]))]
    while len(parts) < most:
        index = max(range(len(parts)), key=lambda i: parts[i][1].volume)
        halves = _cut(vertices, parts[index][0])
        whole = parts[index][1].volume
        if halves is None or sum(c.volume for _, c in halves) > _WORTH * whole:
            break
        parts[index : index + 1] = halves
    return [capsule for _, capsule in parts]


def fitted_capsule(points: Array) -> Capsule:
    """Return a small capsule around points, shape (m, 3), m.

    A random search over axes from the points' principal ones; the same points give the same one.
    """
    rng = np.random.default_rng(0)
    extremes = _extremes(points)
    centre = points.mean(axis=0)
    axes = np.linalg.svd(extremes - extremes.mean(axis=0))[2]
    middle = 0.5 * ((extremes @ axes.T).max(axis=0) + (extremes @ axes.T).min(axis=0)) @ axes
    scale = max(float(np.abs(extremes - centre).max()), _SMALLEST)
    volumes = _volumes(extremes, axes, np.tile(middle, (3, 1)))
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


def _cut(vertices: Array, triangles: NDArray) -> list[tuple[NDArray, Capsule]] | None:
    """Return the best cut of triangles in two across one of their principal axes."""
    centroids = vertices[triangles].mean(axis=1)
    axes = np.linalg.svd(centroids - centroids.mean(axis=0), full_matrices=False)[2]
    best, least = None, np.inf
    for axis in axes:
        along = centroids @ axis
        low, high = along.min(), along.max()
        for share in _CUTS:
            behind = along < low + share * (high - low)
            if behind.all() or not behind.any():
                continue
            halves = [triangles[behind], triangles[~behind]]
            volume = sum(_rough_volume(vertices[np.unique(half)]) for half in halves)
            if volume < least:
                best, least = halves, volume
    if best is None:
        return None
    return [(half, fitted_capsule(vertices[np.unique(half)])) for half in best]


def _rough_volume(points: Array) -> float:
    axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2]
    along = points @ axes.T
    middle = 0.5 * (along.max(axis=0) + along.min(axis=0)) @ axes
    return float(_volumes(points, axes, np.tile(middle, (len(axes), 1))).min())


def _extremes(points: Array) -> Array:
    """Return the points furthest out in directions spread over the sphere."""
    k = np.arange(_EXTREMES) + 0.5
    height, angle = 1.0 - 2.0 * k / _EXTREMES, np.pi * (1.0 + 5.0**0.5) * k
    ring = np.sqrt(1.0 - height**2)
    directions = np.stack([ring * np.cos(angle), ring * np.sin(angle), height])
    return points[np.unique(np.argmax(points @ directions, axis=0))]


def _volumes(points: Array, axes: Array, origins: Array) -> Array:
    """Return the volumes of the capsules along lines, each given by an axis and an origin."""
    along, across2 = _coordinates(points, axes, origins)
    radius2 = across2.max(axis=1)
    cap = np.sqrt(radius2[:, None] - across2)
    length = ((along - cap).max(axis=1) - (along + cap).min(axis=1)).clip(0.0)
    radius = np.sqrt(radius2)
    return np.pi * radius2 * (length + 4.0 / 3.0 * radius)


def _capsule_along(points: Array, axis: Array, origin: Array) -> Capsule:
    along, across2 = _coordinates(points, axis[None], origin[None])
    along, across2 = along[0], across2[0]
    radius = max(float(np.sqrt(across2.max())), _SMALLEST)
    cap = np.sqrt(np.maximum(radius**2 - across2, 0.0))
    low, high = float((along + cap).min()), float((along - cap).max())
    if low > high:
        low = high = 0.5 * (low + high)
    start, end = origin + low * axis, origin + high * axis
    # What rounding lacks, so that all points are inside.
    return Capsule(start, end, max(radius, float(_distance(points, start, end).max())) + 1e-12)


def _coordinates(points: Array, axes: Array, origins: Array) -> tuple[Array, Array]:
    """Return positions along lines and squared distances from them, shape (lines, points)."""
    along = axes @ points.T - np.sum(axes * origins, axis=1)[:, None]
    squared = np.sum(points**2, axis=1)[None] - 2.0 * origins @ points.T
    squared += np.sum(origins**2, axis=1)[:, None]
    return along, np.maximum(squared - along**2, 0.0)


def _distance(points: Array, start: Array, end: Array) -> Array:
    """Return the distances of points from a segment, shape (m,)."""
    axis = end - start
    square = float(axis @ axis)
    share = ((points - start) @ axis / square).clip(0.0, 1.0) if square > 0.0 else 0.0
    return np.linalg.norm(points - start - np.multiply.outer(share, axis), axis=1)
