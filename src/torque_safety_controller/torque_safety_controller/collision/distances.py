# SPDX-License-Identifier: Apache-2.0
"""Distances of pairs of bodies, compiled."""

from __future__ import annotations

from math import inf
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torque_safety_controller.collision.closest_points import (
    MET,
    SurfacePoint,
    across,
    point_to_box,
    segment_to_box,
)
from torque_safety_controller.collision.motion import ArmMotion, Bodies, place_bodies
from torque_safety_controller.collision.vectors3 import (
    Vector,
    along,
    at,
    column,
    compiled_vectors,
    in_axes,
    sub,
)

Array = NDArray[np.float64]


class Pairs(NamedTuple):
    """Which bodies are kept apart.

    Attributes:
        first: a capsule along its z axis, shape (p,), int.
        second: any body, shape (p,), int.
        moves: 1 for joints that move the first body only, -1 the second only, shape (p, n).
    """

    first: NDArray[np.int64]
    second: NDArray[np.int64]
    moves: Array


class Closest(NamedTuple):
    """Closest points of a segment and a box: `point` in the root frame, `surface` in the box's."""

    share: float
    point: Vector
    surface: SurfacePoint


@compiled_vectors
def closest(i: int, part: int, j: int, other: int, bodies: Bodies, motion: ArmMotion) -> Closest:
    """Return the closest points of a part of capsule `i` and a part of body `j`."""
    axis, h = column(motion.rotation[i], 2), bodies.half[part, 2]
    start = along(at(motion.centre, i), bodies.offset[part, 2] - h, axis)
    R, half = motion.rotation[j], at(bodies.half, other)
    x = sub(in_axes(R, sub(start, at(motion.centre, j))), at(bodies.offset, other))
    u = along((0.0, 0.0, 0.0), 2.0 * h, in_axes(R, axis))
    s = segment_to_box(x, u, half)
    surface = point_to_box(along(x, s, u), half)
    if surface.distance <= MET and half[0] * half[1] * half[2] == 0.0:
        surface = SurfacePoint(surface.distance, across(u, half), surface.free)
    return Closest(s, along(start, 2.0 * s * h, axis), surface)


@compiled_vectors
def is_far(i: int, j: int, near: float, bodies: Bodies, motion: ArmMotion) -> bool:
    """Return whether the ball around a capsule tells that a body is not near."""
    middle = in_axes(motion.rotation[j], sub(at(motion.centre, i), at(motion.centre, j)))
    d = point_to_box(middle, at(bodies.half, bodies.first[j])).distance
    length = bodies.half[bodies.first[i], 2]
    outside: bool = d - length - bodies.radius[i] - bodies.radius[j] > near
    return outside


@compiled_vectors
def pair_distances(
    near: float, pairs: Pairs, bodies: Bodies, motion: ArmMotion, distances: Array
) -> None:
    """Fill in the distances of all pairs, shape (p,), m; inf for what is not near."""
    place_bodies(bodies, motion)
    for k in range(len(distances)):
        i, j = pairs.first[k], pairs.second[k]
        distances[k] = inf
        if not is_far(i, j, near, bodies, motion):
            found = closest(i, bodies.first[i], j, bodies.first[j], bodies, motion)
            distances[k] = found.surface.distance - bodies.radius[i] - bodies.radius[j]
