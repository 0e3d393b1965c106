"""From a state of the arm to rows on its joint accelerations, compiled.

For each pair of bodies that is near enough, the rows of several distances: between the closest
points, and between each end or edge of either body and the other body. So the closest points may
jump from one end to the other, as between parallel segments, and the row is there already.
"""

from __future__ import annotations

from math import inf, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torque_safety_controller.collision.closest_points import (
    between_segments,
    in_axes,
    on_segment,
    point_to_box,
    segment_to_box,
)
from torque_safety_controller.collision.kinematics import move, place, point_motion
from torque_safety_controller.collision.row import slides_along, write_row
from torque_safety_controller.collision.vectors3 import (
    along,
    at,
    column,
    compiled,
    cross,
    dot,
    sub,
    turned,
)

Array = NDArray[np.float64]

CAPSULES, BOX, HALF_SPACE = 0, 1, 2
ROWS_OF_KIND = np.array([5, 15, 2])
"""How many rows a pair of each kind has at most."""

_MET = 1e-9  # m; points that are nearer have no direction
_SAME = 1e-6  # m and shares of a segment
_STILL = (0.0, 0.0, 0.0)
# Not plain integers, for each of which numba would compile the functions that take them anew.
_BASE = np.int64(0)
_FLAT = np.int64(-1)


class Bodies(NamedTuple):
    """Shapes as the kernels read them.

    Attributes:
        joint: that moves a capsule, shape (c,), int; 0 for what stands still.
        start: of its segment in the joint's axes, shape (c, 3), m.
        segment: from there to its end, shape (c, 3), m.
        radius: shape (c,), m.
        box_axes: as columns, shape (b, 3, 3).
        box_centre: shape (b, 3), m.
        box_half: half the lengths of the edges, shape (b, 3), m.
        normal: of half spaces, shape (h, 3).
        level: the solid is where ``normal . x < level``, shape (h,), m.
    """

    joint: NDArray[np.int64]
    start: Array
    segment: Array
    radius: Array
    box_axes: Array
    box_centre: Array
    box_half: Array
    normal: Array
    level: Array


class Pairs(NamedTuple):
    """Which bodies are kept apart; arrays of shape (p,), int.

    Attributes:
        kind: CAPSULES, BOX or HALF_SPACE.
        first: a capsule.
        second: another one, a box or a half space.
    """

    kind: NDArray[np.int64]
    first: NDArray[np.int64]
    second: NDArray[np.int64]


@compiled
def place_capsules(motion, bodies, rows):
    """Put the segments of all capsules into the base frame."""
    for i in range(len(bodies.joint)):
        j = bodies.joint[i]
        p = place(motion, j, at(bodies.start, i))
        u = turned(motion.rotation[j], at(bodies.segment, i))
        for k in range(3):
            rows.start[i, k] = p[k]
            rows.segment[i, k] = u[k]


@compiled
def distance_of(kind, i, j, bodies, rows):
    """Return the distance of a pair whose capsules are placed, negative if they overlap, m."""
    a, u = at(rows.start, i), at(rows.segment, i)
    if kind == CAPSULES:
        b, w = at(rows.start, j), at(rows.segment, j)
        s, t = between_segments(a, u, b, w)
        c = sub(along(a, s, u), along(b, t, w))
        return sqrt(dot(c, c)) - bodies.radius[i] - bodies.radius[j]
    if kind == BOX:
        R, half = bodies.box_axes[j], at(bodies.box_half, j)
        x, y = in_axes(a, R, at(bodies.box_centre, j)), in_axes(u, R, _STILL)
        return point_to_box(along(x, segment_to_box(x, y, half), y), half)[0] - bodies.radius[i]
    n = at(bodies.normal, j)
    return min(dot(n, a), dot(n, along(a, 1.0, u))) - bodies.level[j] - bodies.radius[i]


@compiled
def _ball(i, motion, bodies, rows):
    """Return a capsule's middle, its velocity, and what its ends add to distance and speed."""
    half = along(_STILL, 0.5, at(rows.segment, i))
    middle = along(at(rows.start, i), 1.0, half)
    turning = at(motion.turning, bodies.joint[i])
    v, _ = point_motion(motion, bodies.joint[i], middle)
    length = sqrt(dot(half, half))
    return middle, v, length + bodies.radius[i], sqrt(dot(turning, turning)) * length


@compiled
def _gap_and_speed(kind, i, j, motion, bodies, rows):
    """Return less than the distance of a pair, and more than the speed of its approach."""
    middle, v, reach, swing = _ball(i, motion, bodies, rows)
    if kind == CAPSULES:
        centre, v_other, reach_other, swing_other = _ball(j, motion, bodies, rows)
        c = sub(middle, centre)
        v = sub(v, v_other)
        gap, swing = sqrt(dot(c, c)) - reach_other, swing + swing_other
    elif kind == BOX:
        x = in_axes(middle, bodies.box_axes[j], at(bodies.box_centre, j))
        gap = point_to_box(x, at(bodies.box_half, j))[0]
    else:
        gap = dot(at(bodies.normal, j), middle) - bodies.level[j]
    return gap - reach, sqrt(dot(v, v)) + swing


@compiled
def _is_new(s, o, known, counts):
    """Return whether no row of the pair belongs to these points yet, and note that one does."""
    count = counts[1]
    for k in range(count):
        seen = known[k]
        c = (o[0] - seen[1], o[1] - seen[2], o[2] - seen[3])
        if abs(s - seen[0]) < _SAME and dot(c, c) < _SAME * _SAME:
            return False
    seen = known[count]
    seen[0], seen[1], seen[2], seen[3] = s, o[0], o[1], o[2]
    counts[1] = count + 1
    return True


@compiled
def _direction(c, u, w):
    """Return |c| and its direction; for axes that meet, one across both of them."""
    d = sqrt(dot(c, c))
    if d > _MET:
        return d, (c[0] / d, c[1] / d, c[2] / d)
    n = cross(u, w)
    if not dot(n, n) > 1e-16:
        n = cross(u, (1.0, 0.0, 0.0) if abs(u[0]) <= abs(u[2]) else (0.0, 0.0, 1.0))
    size = sqrt(dot(n, n))
    if not size > 1e-12:
        return d, (0.0, 0.0, 1.0)
    return d, (n[0] / size, n[1] / size, n[2] / size)


@compiled
def _segment_rows(pair, i, b, w, other, radius, near, ends, bodies, step, chain, motion, rows):
    """Write the rows of capsule `i` and a segment from b to b + w, moved by joint `other`.

    With `ends`, also those between each end and the other segment.
    """
    joint = bodies.joint[i]
    a, u = at(rows.start, i), at(rows.segment, i)
    free, turns = rows.free, rows.turning
    closest = between_segments(a, u, b, w)
    for feature in range(5 if ends else 1):
        s, t = closest
        if feature == 1 or feature == 2:
            s = float(feature - 1)
            t = on_segment(along(a, s, u), b, w)
        elif feature > 2:
            t = float(feature - 3)
            s = on_segment(along(b, t, w), a, u)
        p, o = along(a, s, u), along(b, t, w)
        c = sub(p, o)
        if dot(c, c) > (near + radius) ** 2 or not _is_new(s, o, rows.seen, rows.count):
            continue
        d, n = _direction(c, u, w)
        sliding = 0
        if 0.0 < s < 1.0:
            sliding = slides_along(sliding, u, at(motion.turning, joint), free, turns)
        if 0.0 < t < 1.0:
            sliding = slides_along(sliding, w, at(motion.turning, other), free, turns)
        write_row(pair, d, radius, n, p, joint, o, other, sliding, step, chain, motion, rows)


@compiled
def _box_rows(pair, i, j, near, bodies, step, chain, motion, rows):
    """Write the rows of capsule `i` and box `j`: closest points, ends, and the box's edges."""
    joint, radius = bodies.joint[i], bodies.radius[i]
    a, u = at(rows.start, i), at(rows.segment, i)
    R, centre, half = bodies.box_axes[j], at(bodies.box_centre, j), at(bodies.box_half, j)
    x, y = in_axes(a, R, centre), in_axes(u, R, _STILL)
    free, turns = rows.free, rows.turning
    for feature in range(3):
        s = segment_to_box(x, y, half) if feature == 0 else float(feature - 1)
        inside = along(x, s, y)
        d, normal, faces = point_to_box(inside, half)
        p, n = along(a, s, u), turned(R, normal)
        o = along(p, -d, n)
        if d > near + radius or not _is_new(s, o, rows.seen, rows.count):
            continue
        sliding = 0
        for m in range(3):
            if faces[m]:
                sliding = slides_along(sliding, column(R, m), _STILL, free, turns)
        if 0.0 < s < 1.0:
            sliding = slides_along(sliding, u, at(motion.turning, joint), free, turns)
        write_row(pair, d, radius, n, p, joint, o, _BASE, sliding, step, chain, motion, rows)
    for m in range(3):
        first, second = (m + 1) % 3, (m + 2) % 3
        for corner in range(4):
            b = along(centre, -half[m], column(R, m))
            b = along(b, half[first] if corner & 1 else -half[first], column(R, first))
            b = along(b, half[second] if corner & 2 else -half[second], column(R, second))
            w = along(_STILL, 2.0 * half[m], column(R, m))
            _segment_rows(pair, i, b, w, _BASE, radius, near, False, bodies, step,
                          chain, motion, rows)  # fmt: skip


@compiled
def collision_rows(q, v, pairs, bodies, step, chain, motion, rows):
    """Fill in `rows`, and return how many there are.

    Args:
        q: shape (n,), rad.
        v: shape (n,), rad/s.
        pairs: of bodies to keep apart.
        bodies: shapes.
        step: bounds and law.
        chain: constants of the joints.
        motion: to fill in.
        rows: to fill in.
    """
    law = step.law
    move(q, v, chain, motion)
    place_capsules(motion, bodies, rows)
    rows.count[0] = 0
    for pair in range(len(pairs.kind)):
        kind, i, j = pairs.kind[pair], pairs.first[pair], pairs.second[pair]
        gap, speed = _gap_and_speed(kind, i, j, motion, bodies, rows)
        stopping = law.margin + law.reserve + law.dt * speed + speed * speed / law.braking
        near = max(law.influence, stopping)
        rows.found[pair] = inf
        if gap > near:
            continue
        rows.found[pair] = distance_of(kind, i, j, bodies, rows)
        if rows.found[pair] > near:
            continue
        rows.count[1] = 0
        if kind == CAPSULES:
            b, w, other = at(rows.start, j), at(rows.segment, j), bodies.joint[j]
            radius = bodies.radius[i] + bodies.radius[j]
            _segment_rows(pair, i, b, w, other, radius, near, True, bodies, step,
                          chain, motion, rows)  # fmt: skip
        elif kind == BOX:
            _box_rows(pair, i, j, near, bodies, step, chain, motion, rows)
        else:
            n = at(bodies.normal, j)
            u = at(rows.segment, i)
            for end in range(2 if dot(u, u) > 0.0 else 1):
                p = along(at(rows.start, i), float(end), u)
                d = dot(n, p) - bodies.level[j]
                write_row(pair, d, bodies.radius[i], n, p, bodies.joint[i], p, _BASE, _FLAT, step,
                          chain, motion, rows)  # fmt: skip
    return rows.count[0]
