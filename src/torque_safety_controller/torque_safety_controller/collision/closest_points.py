# SPDX-License-Identifier: Apache-2.0
"""Closest points of a segment and a box, in closed form and compiled.

All vectors are in the axes of the box, whose corners are at +- `half`. A box with lengths of zero
is a segment or a point.
"""

from __future__ import annotations

from math import sqrt
from typing import NamedTuple

from torque_safety_controller.collision.vectors3 import (
    Vector,
    along,
    compiled_vectors,
    cross,
    dot,
)

MET = 1e-9
"""Distance, m, below which two points give no direction."""

_SHORT = 1e-12  # m^2; a segment with less is a point
_BISECTIONS = 60  # to rounding


class SurfacePoint(NamedTuple):
    """The point of a box nearest to a given one.

    Attributes:
        distance: signed, m; negative inside the box.
        normal: unit vector out of the box.
        free: whether the nearest point may slide along each axis: those of its face or edge.
    """

    distance: float
    normal: Vector
    free: tuple[bool, bool, bool]


@compiled_vectors
def clamp(x: float, limit: float) -> float:
    """Return the number of [-limit, limit] that is nearest to x."""
    return min(max(x, -limit), limit)


@compiled_vectors
def _slope(s: float, a: Vector, u: Vector, half: Vector) -> float:
    """Return half the derivative of the squared distance of a + s u from the box."""
    slope = 0.0
    for k in range(3):
        x = a[k] + s * u[k]
        slope += u[k] * (x - clamp(x, half[k]))
    return slope


@compiled_vectors
def _depth(x: Vector, half: Vector) -> float:
    """Return the signed distance of a point from the nearest face; negative inside the box."""
    return max(abs(x[0]) - half[0], abs(x[1]) - half[1], abs(x[2]) - half[2])


@compiled_vectors
def segment_to_box(a: Vector, u: Vector, half: Vector) -> float:
    """Return s in [0, 1] so that a + s u is nearest to the box, or deepest in it.

    The squared distance is convex and piecewise quadratic in s: its slope is evaluated where the
    line crosses the planes of the faces, and interpolated between two of these.
    """
    if dot(u, u) <= _SHORT:
        return 0.0
    low, high = 0.0, 1.0
    slope_low, slope_high = _slope(0.0, a, u, half), _slope(1.0, a, u, half)
    if slope_low > 0.0:
        s = 0.0
    elif slope_high < 0.0:
        s = 1.0
    else:
        for k in range(3):
            for face in (-half[k], half[k]):
                x = (face - a[k]) / u[k]  # not finite along the face
                if low < x < high:
                    slope = _slope(x, a, u, half)
                    if slope < 0.0:
                        low, slope_low = x, slope
                    else:
                        high, slope_high = x, slope
        rise = slope_high - slope_low
        s = low - (high - low) * slope_low / rise if rise > 0.0 else 0.5 * (low + high)
    if _depth(along(a, s, u), half) > MET:
        return s
    # The segment goes through the box: the depth is convex in s, too.
    low, high = 0.0, 1.0
    for _ in range(_BISECTIONS):
        third = (high - low) / 3.0
        if _depth(along(a, low + third, u), half) < _depth(along(a, high - third, u), half):
            high -= third
        else:
            low += third
    return 0.5 * (low + high)


@compiled_vectors
def point_to_box(x: Vector, half: Vector) -> SurfacePoint:
    """Return the nearest point of the surface; inside the box that of the nearest face."""
    r = (x[0] - clamp(x[0], half[0]), x[1] - clamp(x[1], half[1]), x[2] - clamp(x[2], half[2]))
    d = sqrt(dot(r, r))
    if d > MET:
        inside = (abs(x[0]) < half[0], abs(x[1]) < half[1], abs(x[2]) < half[2])
        return SurfacePoint(d, (r[0] / d, r[1] / d, r[2] / d), inside)
    depth = _depth(x, half)
    if abs(x[0]) - half[0] == depth:
        return SurfacePoint(depth, (1.0 if x[0] >= 0.0 else -1.0, 0.0, 0.0), (False, True, True))
    if abs(x[1]) - half[1] == depth:
        return SurfacePoint(depth, (0.0, 1.0 if x[1] >= 0.0 else -1.0, 0.0), (True, False, True))
    return SurfacePoint(depth, (0.0, 0.0, 1.0 if x[2] >= 0.0 else -1.0), (True, True, False))


@compiled_vectors
def across(u: Vector, w: Vector) -> Vector:
    """Return a unit vector across two directions, or across one if they are parallel."""
    x, y = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)
    for n in (cross(u, w), cross(u, x), cross(u, y), cross(w, x), cross(w, y)):
        size = sqrt(dot(n, n))
        if size > MET:
            return n[0] / size, n[1] / size, n[2] / size
    return 0.0, 0.0, 1.0
