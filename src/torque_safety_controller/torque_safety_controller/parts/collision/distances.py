# SPDX-License-Identifier: Apache-2.0
"""Distances between capsules and obstacles, with their first and second derivatives, compiled.

All bodies are segments with a radius, except boxes: these have segments as edges, and a segment
that is the point nearest to something, or the edge through it. Segments move with their two ends:
positions, velocities and accelerations in between are interpolated.
`docs/guides/collision.md` derives the formulas.
"""

from __future__ import annotations

from math import inf, sqrt

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

_MET = 1e-9  # m; axes nearer than this give no direction
_BLUNT = 1e-3  # m; no curvature is computed for axes nearer than this
# Squared sine of the angle between two segments below which their closest points slide so fast
# that the distances of the ends count instead.
_PARALLEL = 1e-2
_SAME = 1e-6  # lines that differ by less are one
_PIECE = 1e-3  # m; half the length of an edge that stands for it around a point
_BEHIND = 1.0  # m; how far behind a face its reference point is, so that the normal is exact


@njit(cache=True)
def move_segments(
    v: Array, parent: Integers, placements: Array, J: Array, dJ: Array, joint: Integers,
    ends: Array, twists: Array, points: Array,
) -> None:  # fmt: skip
    """Compute how the ends of segments move.

    Args:
        v: joint velocities, shape (n,), rad/s.
        parent: of each joint, shape (n + 1,), int.
        placements: of the joints: rows of the rotation, then the origin, m, shape (n + 1, 4, 3).
        J: spatial velocity of each joint about the root's origin for a unit joint velocity, linear
            first, shape (n, 6).
        dJ: its time derivative, shape (n, 6).
        joint: see `model.Segments`.
        ends: see `model.Segments`.
        twists: written: spatial velocity of each joint, and its rate, shape (n + 1, 2, 6).
        points: written: position, velocity, and acceleration at zero joint acceleration, of both
            ends of each segment, shape (s, 2, 3, 3), m, m/s, m/s^2.
    """
    for m in range(1, len(parent)):
        for k in range(6):
            twists[m, 0, k] = twists[parent[m], 0, k] + J[m - 1, k] * v[m - 1]
            twists[m, 1, k] = twists[parent[m], 1, k] + dJ[m - 1, k] * v[m - 1]
    for i in range(len(joint)):
        m = joint[i]
        for e in range(2):
            for k in range(3):
                x = placements[m, 3, k]
                for c in range(3):
                    x += placements[m, k, c] * ends[i, e, c]
                points[i, e, 0, k] = x
            # Velocity v + w x p; acceleration dv + dw x p + w x (v + w x p).
            for order in range(2):
                for k in range(3):
                    y, z = (k + 1) % 3, (k + 2) % 3
                    x = twists[m, order, k]
                    for lower in range(order + 1):
                        turning = order - lower
                        x += twists[m, turning, 3 + y] * points[i, e, lower, z]
                        x -= twists[m, turning, 3 + z] * points[i, e, lower, y]
                    points[i, e, order + 1, k] = x


@njit(cache=True)
def find_features(
    radius: Array, boxes: Array, start: Integers, bodies: Integers, share: Array, points: Array,
    near: float, kept: float, dt: float, braking: float, distances: Array, pair_of: Integers,
    line: Array, motion: Array,
) -> int:  # fmt: skip
    """Write the distances that matter in a state, and return how many there are.

    Args:
        radius: see `model.Segments`, like `boxes`.
        boxes: likewise.
        start: see `model.Candidates`, like `bodies` and `share`.
        bodies: likewise.
        share: likewise.
        points: of `move_segments`.
        near: distance within which pairs matter that do not approach fast, m.
        kept: distance to be kept, m.
        dt: how long an acceleration is held, s.
        braking: deceleration that distances count on, m/s^2.
        distances: written: of all pairs, shape (p,), m; inf for those that do not matter.
        pair_of: written: pair that each belongs to, shape (c,), int.
        line: written: unit vector from the second body to the first, and its moment about the
            root's origin, shape (c, 6): the distance's gradient is ``line (J_first - J_second)``.
        motion: written: distance, m, its rate, m/s, and its acceleration at zero joint
            acceleration, m/s^2, shape (c, 3).
    """
    count = 0
    for pair in range(len(distances)):
        i, j, box = bodies[start[pair], 0], bodies[start[pair], 1], bodies[start[pair], 2]
        if box >= 0:
            _place_foot(i, 0.5, boxes, box, radius, j, points)
        gap, speed = _apart(i, j, points)
        gap -= radius[i] + radius[j]
        limit = max(near, kept + dt * speed + speed * speed / braking)
        distances[pair] = inf
        if gap > limit:
            continue
        first, pierced = count, False
        for c in range(start[pair], start[pair + 1]):
            j, box, s_low, s_high = bodies[c, 1], bodies[c, 2], share[c, 0], share[c, 1]
            if box >= 0:
                if s_low < s_high:
                    s_low = s_high = _chord(i, boxes, box, points)
                    if s_low < 0.0:
                        continue
                    pierced = True
                _place_foot(i, s_low, boxes, box, radius, j, points)
            elif pierced:
                continue
            s, t = _closest(i, s_low, s_high, j, share[c, 2], share[c, 3], points)
            edge = box < 0 and bodies[start[pair], 2] >= 0
            if edge and not 0.0 < s < 1.0:
                continue  # the ends have distances of their own
            flat = box >= 0 and radius[j] > 0.0
            d = _write_feature(i, s, j, t, flat, points, line[count], motion[count])
            gap = motion[count, 0] = d - radius[i] - radius[j]
            distances[pair] = min(distances[pair], gap)
            known = gap > limit
            for other in range(first, count):
                off = abs(motion[other, 0] - gap)
                for k in range(6):
                    off = max(off, abs(line[other, k] - line[count, k]))
                known = known or off < _SAME
            if not known:
                pair_of[count] = pair
                count += 1
    return count


@njit(cache=True)
def _apart(i: int, j: int, points: Array) -> tuple[float, float]:
    """Return a distance that two axes are not nearer than, m, and their highest speed, m/s.

    The distance is that of the balls around them; the speed, of a point of one relative to a point
    of the other.
    """
    between, u, w, fastest = 0.0, 0.0, 0.0, 0.0
    for k in range(3):
        p, p_end, o, o_end = (
            points[i, 0, 0, k],
            points[i, 1, 0, k],
            points[j, 0, 0, k],
            points[j, 1, 0, k],
        )
        between += 0.25 * (p + p_end - o - o_end) ** 2
        u, w = u + (p_end - p) ** 2, w + (o_end - o) ** 2
    for e in range(2):
        for f in range(2):
            square = 0.0
            for k in range(3):
                square += (points[i, e, 1, k] - points[j, f, 1, k]) ** 2
            fastest = max(fastest, square)
    return sqrt(between) - 0.5 * (sqrt(u) + sqrt(w)), sqrt(fastest)


@njit(cache=True)
def _closest(
    i: int, s_low: float, s_high: float, j: int, t_low: float, t_high: float, points: Array
) -> tuple[float, float]:
    """Return the shares of two segments at which they are closest: 5.1.9 of [Ericson2005]."""
    a, b, c, e, f = 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(3):
        u = points[i, 1, 0, k] - points[i, 0, 0, k]
        w = points[j, 1, 0, k] - points[j, 0, 0, k]
        r = points[i, 0, 0, k] - points[j, 0, 0, k]
        a, b, c, e, f = a + u * u, b + u * w, c + u * r, e + w * w, f + w * r
    s, t, across = s_low, t_low, a * e - b * b
    if across > 0.0:
        s = min(max((b * f - c * e) / across, s_low), s_high)
    if e > 0.0:
        t = min(max((b * s + f) / e, t_low), t_high)
    if a > 0.0:
        s = min(max((b * t - c) / a, s_low), s_high)
    return s, t


@njit(cache=True)
def _place_foot(
    i: int, s: float, boxes: Array, box: int, radius: Array, j: int, points: Array
) -> None:
    """Make segment j the point of a box that is nearest to a point of segment i.

    At an edge it is a piece of the edge around that point. Before a face or inside, it is a point
    behind the nearest face, with a radius up to the face.
    """
    x, beyond, face, most = np.empty(3), 0, 0, -inf
    for m in range(3):
        x[m] = 0.0
        for k in range(3):
            p = (1.0 - s) * points[i, 0, 0, k] + s * points[i, 1, 0, k]
            x[m] += boxes[box, 2 + m, k] * (p - boxes[box, 0, k])
        out = abs(x[m]) - boxes[box, 1, m]
        beyond += out > 0.0
        if out > most:
            face, most = m, out
    radius[j] = _BEHIND if beyond < 2 else 0.0
    for k in range(3):
        points[j, 0, 0, k] = points[j, 1, 0, k] = boxes[box, 0, k]
    for m in range(3):
        half = boxes[box, 1, m]
        foot, reach = min(max(x[m], -half), half), 0.0
        if beyond < 2 and m == face:
            foot = half - _BEHIND if x[m] > 0.0 else _BEHIND - half
        elif beyond == 2 and abs(x[m]) <= half:
            reach = _PIECE
        for k in range(3):
            points[j, 0, 0, k] += (foot - reach) * boxes[box, 2 + m, k]
            points[j, 1, 0, k] += (foot + reach) * boxes[box, 2 + m, k]


@njit(cache=True)
def _chord(i: int, boxes: Array, box: int, points: Array) -> float:
    """Return the share of segment i at the middle of its part inside a box; -1 without one."""
    enters, leaves = 0.0, 1.0
    for m in range(3):
        x, u, half = 0.0, 0.0, boxes[box, 1, m]
        for k in range(3):
            x += boxes[box, 2 + m, k] * (points[i, 0, 0, k] - boxes[box, 0, k])
            u += boxes[box, 2 + m, k] * (points[i, 1, 0, k] - points[i, 0, 0, k])
        if abs(u) > _MET:
            enters = max(enters, min((-half - x) / u, (half - x) / u))
            leaves = min(leaves, max((-half - x) / u, (half - x) / u))
        elif abs(x) > half:
            return -1.0
    return 0.5 * (enters + leaves) if enters < leaves else -1.0


@njit(cache=True)
def _write_feature(
    i: int, s: float, j: int, t: float, flat: bool, points: Array, line: Array, motion: Array
) -> float:
    """Write line, rate and acceleration of a distance; return that of the axes, m.

    Where the axes meet, the line is across both, or any.

    Args:
        i: the first segment.
        s: share of it at which its closest point is.
        j: the second segment.
        t: likewise.
        flat: whether the second is a face.
        points: of `move_segments`.
        line: written, see `find_features`.
        motion: rate and acceleration are written.
    """
    for k in range(3):
        line[k] = (1.0 - s) * points[i, 0, 0, k] + s * points[i, 1, 0, k]
        line[k] -= (1.0 - t) * points[j, 0, 0, k] + t * points[j, 1, 0, k]
    size = d = sqrt(line[0] ** 2 + line[1] ** 2 + line[2] ** 2)
    if d <= _MET:
        for k in range(3):
            y, z = (k + 1) % 3, (k + 2) % 3
            u_y, u_z = (
                points[i, 1, 0, y] - points[i, 0, 0, y],
                points[i, 1, 0, z] - points[i, 0, 0, z],
            )
            w_y, w_z = (
                points[j, 1, 0, y] - points[j, 0, 0, y],
                points[j, 1, 0, z] - points[j, 0, 0, z],
            )
            line[k] = u_y * w_z - u_z * w_y + _MET * (0.5 + 0.1 * k)
        size = sqrt(line[0] ** 2 + line[1] ** 2 + line[2] ** 2)
    for k in range(3):
        line[k] /= size
    rate, bias, square, w_s, w_t, a, b, e = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(3):
        y, z = (k + 1) % 3, (k + 2) % 3
        p_y = (1.0 - s) * points[i, 0, 0, y] + s * points[i, 1, 0, y]
        p_z = (1.0 - s) * points[i, 0, 0, z] + s * points[i, 1, 0, z]
        line[3 + k] = p_y * line[z] - p_z * line[y]
        # Velocity and acceleration of the first point relative to the second.
        v = (1.0 - s) * points[i, 0, 1, k] + s * points[i, 1, 1, k]
        v -= (1.0 - t) * points[j, 0, 1, k] + t * points[j, 1, 1, k]
        dv = (1.0 - s) * points[i, 0, 2, k] + s * points[i, 1, 2, k]
        dv -= (1.0 - t) * points[j, 0, 2, k] + t * points[j, 1, 2, k]
        # The segments from end to end, and their rates.
        u, du = points[i, 1, 0, k] - points[i, 0, 0, k], points[i, 1, 1, k] - points[i, 0, 1, k]
        w, dw = points[j, 1, 0, k] - points[j, 0, 0, k], points[j, 1, 1, k] - points[j, 0, 1, k]
        rate, bias, square = rate + line[k] * v, bias + line[k] * dv, square + v * v
        w_s += v * u + d * line[k] * du
        w_t += v * w + d * line[k] * dw
        a, b, e = a + u * u, b + u * w, e + w * w
    if not flat and d >= _BLUNT:
        # What sliding leaves of the curvature, less w' H^-1 w, by elimination.
        curved, pivot = square - rate * rate, a
        if 0.0 < t < 1.0 and e > 0.0:
            curved -= w_t * w_t / e
            w_s -= b / e * w_t
            pivot = max(a - b * b / e, _PARALLEL * a)
        if 0.0 < s < 1.0 and a > 0.0:
            curved -= w_s * w_s / pivot
        bias += curved / d
    motion[1], motion[2] = rate, bias
    return d
