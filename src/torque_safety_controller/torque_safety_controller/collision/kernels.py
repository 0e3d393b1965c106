# SPDX-License-Identifier: Apache-2.0
"""From a state of the arm to linear constraints on its joint accelerations, compiled.

Every body is a box with rounded edges, which may be thin: a capsule is a segment, a sphere a
point. For each pair that is near enough there are rows for several distances: between the closest
points, and between each end or edge of either body and the other body. So the closest points may
jump from one end to the other, as between parallel segments, and the row is there already.

`docs/collision_avoidance.md` derives the formulas: d'' = G a + bias along the motion, and the
lowest d'' from which the distance can be kept, as for the lower limit of a joint.
"""

from __future__ import annotations

from math import inf, sqrt
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
from torque_safety_controller.collision.vectors3 import (
    Vector,
    along,
    at,
    column,
    compiled_vectors,
    cross,
    dot,
    in_axes,
    sub,
    times,
)
from viability_bounds_pkg.kernel.bounds_kernel import joint_bounds
from viability_bounds_pkg.kernel.one_sided_limit import JointTable

Array = NDArray[np.float64]

RESERVE = 0.002
"""Kept on top of the margin for what the linearisation within a step may take, m."""

BRAKING_SHARE = 0.3
"""Share of what the joints can do along a distance that it counts on, up to `braking`."""

RECOVERY_SPEED = 0.1
"""Speed at which bodies inside the margin are parted, m/s."""

_BLUNT = 1e-3  # m; no curvature is computed for axes nearer than this
# Squared sine of the angle between two segments, or a segment and a face, below which the
# closest points slide so fast that the rows of the ends take over.
_PARALLEL = 1e-2
_SAME = 1e-6  # m; features whose closest points are nearer than this are one
_LEAST_BRAKING = 1e-2  # m/s^2
_LEAST_SHARE = 0.1
_LEVER = 0.1  # m/rad
_ROUNDING = 1e-9


class Bodies(NamedTuple):
    """Boxes with rounded edges, and their parts: first the whole, then its edges or ends.

    Attributes:
        joint: that moves the body, shape (b,), int; 0 for what does not move.
        rotation: of the box in the joint's axes, shape (b, 3, 3).
        centre: of the box there, shape (b, 3), m.
        radius: of the rounding, shape (b,), m.
        plane: whether only the distances of the other body's ends count, shape (b,), bool.
        first: index of the first of its parts, shape (b + 1,), int.
        offset: of a part in the axes of the box, shape (m, 3), m.
        half: half the lengths of a part, shape (m, 3), m.
    """

    joint: NDArray[np.int64]
    rotation: Array
    centre: Array
    radius: Array
    plane: NDArray[np.bool_]
    first: NDArray[np.int64]
    offset: Array
    half: Array


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


class ArmMotion(NamedTuple):
    """Where bodies are, and how joints move; all in the root frame, joint 0 is the root.

    Spatial velocities are about the root's origin: linear, then angular.

    Attributes:
        parent: of each joint, shape (n + 1,), int.
        placements: of the joints: the rows of the rotation, then the origin, m, shape
            (n + 1, 4, 3).
        J: spatial velocity of each joint for a unit joint velocity, shape (n, 2, 3).
        dJ: its time derivative, shape (n, 2, 3).
        velocity: spatial velocities of the joints, shape (n + 1, 2, 3), m/s and rad/s.
        bias: their rates at zero joint acceleration, shape (n + 1, 2, 3).
        rotation: of the bodies, shape (b, 3, 3).
        centre: of the bodies, shape (b, 3), m.
    """

    parent: NDArray[np.int64]
    placements: Array
    J: Array
    dJ: Array
    velocity: Array
    bias: Array
    rotation: Array
    centre: Array


class JointBounds(NamedTuple):
    """What the joints can do in one step; arrays of shape (n,), rad/s^2.

    Attributes:
        lower: of the accelerations.
        upper: of the accelerations.
        disturbance: what comes on top of accelerations that are asked for.
        braking: what each joint can brake with.
    """

    lower: Array
    upper: Array
    disturbance: Array
    braking: Array


class DistanceLimits(NamedTuple):
    """What distances are kept and how.

    Attributes:
        kept: distance to keep, margin and `RESERVE`, m.
        braking: deceleration that a distance counts on at most, m/s^2.
        speed_max: of approach, m/s.
        influence: distance beyond which only fast approach matters, m.
        dt: how long an acceleration is held, s.
    """

    kept: float
    braking: float
    speed_max: float
    influence: float
    dt: float


class CollisionRows(NamedTuple):
    """Rows ``G a >= lower``.

    Attributes:
        G: shape (k, n), m/rad.
        lower: shape (k,), m/s^2; never more than some `a` within the bounds reaches.
        pair: index of the pair that a row belongs to, shape (k,), int.
        distance: shape (k,), m; negative where bodies overlap.
        rate: rate of change of the distance, shape (k,), m/s.
        bias: its acceleration at zero joint acceleration, shape (k,), m/s^2, so that its
            acceleration is ``G a + bias``.
        viable: shape (k,), bool; False where the margin is broken, or more braking is needed to
            keep it than is counted on or than the bounds allow.
    """

    G: Array
    lower: Array
    pair: NDArray[np.int64]
    distance: Array
    rate: Array
    bias: Array
    viable: NDArray[np.bool_]


class Workspace(NamedTuple):
    """What stays from step to step: constants, and memory for results.

    Attributes:
        bodies, pairs: of the collision model.
        motion: of both.
        limits: of the distances.
        table: of the virtual joint whose braking is 1.
        rows: written.
        distances: of the pairs, shape (p,), m; inf for what is too far to matter.
        seen: closest points of the pair at hand that have a row, shape (16, 2, 3), m.
    """

    bodies: Bodies
    pairs: Pairs
    motion: ArmMotion
    limits: DistanceLimits
    table: JointTable
    rows: CollisionRows
    distances: Array
    seen: Array


class _Closest(NamedTuple):
    """Closest points of a segment and a box: `point` in the root frame, `surface` in the box's."""

    share: float
    point: Vector
    surface: SurfacePoint


class _Distance(NamedTuple):
    """A distance along the unit vector `n` through point `o`, its rate and its bias."""

    d: float
    rate: float
    bias: float
    n: Vector
    o: Vector


@compiled_vectors
def place_bodies(bodies: Bodies, motion: ArmMotion) -> None:
    """Compute where the bodies are."""
    for i in range(len(bodies.joint)):
        placement = motion.placements[bodies.joint[i]]
        rotation, centre = motion.rotation[i], motion.centre[i]
        for k in range(3):
            turned = times(placement, column(bodies.rotation[i], k))
            rotation[0, k], rotation[1, k], rotation[2, k] = turned
        offset = times(placement, at(bodies.centre, i))
        centre[0], centre[1], centre[2] = along(at(placement, 3), 1.0, offset)


@compiled_vectors
def _move_joints(v: Array, motion: ArmMotion) -> None:
    for i in range(1, len(motion.parent)):
        p = motion.parent[i]
        for k in range(2):
            for m in range(3):
                rate, bias = motion.J[i - 1, k, m], motion.dJ[i - 1, k, m]
                motion.velocity[i, k, m] = motion.velocity[p, k, m] + rate * v[i - 1]
                motion.bias[i, k, m] = motion.bias[p, k, m] + bias * v[i - 1]


@compiled_vectors
def _at_point(field: Array, point: Vector) -> Vector:
    """Return a spatial velocity or acceleration, shape (2, 3), at a point."""
    return along(at(field, 0), 1.0, cross(at(field, 1), point))


@compiled_vectors
def _closest(i: int, part: int, j: int, other: int, bodies: Bodies, motion: ArmMotion) -> _Closest:
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
    return _Closest(s, along(start, 2.0 * s * h, axis), surface)


@compiled_vectors
def _too_far(i: int, j: int, near: float, bodies: Bodies, motion: ArmMotion) -> bool:
    """Return whether the ball around a capsule tells that a body is not near."""
    middle = in_axes(motion.rotation[j], sub(at(motion.centre, i), at(motion.centre, j)))
    d = point_to_box(middle, at(bodies.half, bodies.first[j])).distance
    length = bodies.half[bodies.first[i], 2]
    outside: bool = d - length - bodies.radius[i] - bodies.radius[j] > near
    return outside


@compiled_vectors
def _highest_speed(i: int, j: int, bodies: Bodies, motion: ArmMotion) -> float:
    """Return at least the speed with which two bodies approach each other."""
    first, second = motion.velocity[bodies.joint[i]], motion.velocity[bodies.joint[j]]
    v = sub(_at_point(first, at(motion.centre, i)), _at_point(second, at(motion.centre, j)))
    speed = sqrt(dot(v, v))
    for body, velocity in ((i, first), (j, second)):
        turning, half = at(velocity, 1), at(bodies.half, bodies.first[body])
        speed += sqrt(dot(turning, turning) * dot(half, half))
    return speed


@compiled_vectors
def _is_new(p: Vector, o: Vector, count: int, seen: Array) -> bool:
    """Return whether no row of the pair belongs to these points yet, and note that one does."""
    for k in range(count):
        a, b = sub(p, at(seen[k], 0)), sub(o, at(seen[k], 1))
        if dot(a, a) + dot(b, b) < _SAME * _SAME:
            return False
    for m in range(3):
        seen[count, 0, m], seen[count, 1, m] = p[m], o[m]
    return True


@compiled_vectors
def _pair_rows(k: int, pair: int, near: float, bounds: JointBounds, work: Workspace) -> int:
    """Write the rows of a pair from row `k` on, and its distance; return the next row."""
    bodies, motion = work.bodies, work.motion
    i, j = work.pairs.first[pair], work.pairs.second[pair]
    first, second, end = bodies.first[i], bodies.first[j], bodies.first[j + 1]
    radius, count = bodies.radius[i] + bodies.radius[j], 0
    for part in range(first, bodies.first[i + 1]):
        for other in range(second, end if part == first else second + 1):
            found = _closest(i, part, j, other, bodies, motion)
            d = found.surface.distance
            if part == first and other == second:
                work.distances[pair] = d - radius
                if d - radius > near:
                    return k
                if bodies.plane[j] and bodies.half[part, 2] > 0.0:
                    continue
            n = times(motion.rotation[j], found.surface.normal)
            o = along(found.point, -d, n)
            if d - radius > near or not _is_new(found.point, o, count, work.seen):
                continue
            count += 1
            slides = bodies.half[part, 2] > 0.0 and 0.0 < found.share < 1.0
            rate, bias = _rate_and_bias(i, j, found, n, o, slides, bodies, motion)
            if _write_row(k, pair, _Distance(d - radius, rate, bias, n, o), bounds, work):
                k += 1
    return k


@compiled_vectors
def _rate_and_bias(
    i: int, j: int, found: _Closest, n: Vector, o: Vector, slides: bool, bodies: Bodies,
    motion: ArmMotion,
) -> tuple[float, float]:  # fmt: skip
    """Return the rate of a distance, and its acceleration at zero joint acceleration.

    Args:
        i: the capsule.
        j: the other body.
        found: their closest points.
        n: unit vector from the second body to the first.
        o: closest point of the second body.
        slides: whether the closest point may slide along the capsule.
        bodies: shapes.
        motion: of the bodies.
    """
    first, second, d = bodies.joint[i], bodies.joint[j], found.surface.distance
    turning, turning_other = at(motion.velocity[first], 1), at(motion.velocity[second], 1)
    v, v_other = (
        _at_point(motion.velocity[first], found.point),
        _at_point(motion.velocity[second], o),
    )
    gamma = sub(
        along(_at_point(motion.bias[first], found.point), 1.0, cross(turning, v)),
        along(_at_point(motion.bias[second], o), 1.0, cross(turning_other, v_other)),
    )
    v = sub(v, v_other)
    rate, bias = dot(n, v), dot(n, gamma)
    if d < _BLUNT:
        return rate, bias
    # What sliding takes off: w' H^-1 w with H_ij = e_i . e_j and w_i = v . e_i + c . e_i' for the
    # unit vectors e_i, by elimination. The axes of the box are orthogonal, the capsule's is last.
    u, taken, pivot = column(motion.rotation[i], 2), 0.0, 1.0
    w = dot(v, u) + d * dot(n, cross(turning, u))
    for m in range(3):
        if found.surface.free[m]:
            e = column(motion.rotation[j], m)
            w_m, x = dot(v, e) + d * dot(n, cross(turning_other, e)), dot(u, e)
            taken += w_m * w_m
            w -= x * w_m
            pivot -= x * x
    if slides:
        taken += w * w / max(pivot, _PARALLEL)
    return rate, bias + (dot(v, v) - rate * rate - taken) / d


@compiled_vectors
def _write_row(k: int, pair: int, at_d: _Distance, bounds: JointBounds, work: Workspace) -> bool:
    """Write row `k`, for one distance, unless the bounds imply it; return whether it was."""
    J, moves, limits, rate = work.motion.J, work.pairs.moves[pair], work.limits, at_d.rate
    G, moment = work.rows.G[k], cross(at_d.o, at_d.n)
    brake, most, least, pushed, lever = 0.0, 0.0, 0.0, 0.0, 0.0
    for m in range(len(G)):
        g = 0.0
        if moves[m] != 0.0:
            g = moves[m] * (dot(at_d.n, at(J[m], 0)) + dot(moment, at(J[m], 1)))
        G[m] = g
        brake += abs(g) * bounds.braking[m]
        pushed += g * bounds.disturbance[m]
        low, high = g * bounds.lower[m], g * bounds.upper[m]
        most += max(low, high)
        least += min(low, high)
        lever = max(lever, abs(g))
    # A bias towards the other body takes from the braking, but it falls with the speed squared.
    share = BRAKING_SHARE * brake
    counted = min(limits.braking, share)
    braking = max(min(counted, share + at_d.bias), _LEAST_SHARE * counted, _LEAST_BRAKING)
    room = at_d.d - limits.kept
    wanted = max(_lowest(room, rate, braking, work), (-limits.speed_max - rate) / limits.dt)
    # With which the distance is at its limit after a step. More is never asked for where it
    # approaches its limit or is beyond it, but to end the approach: the last micrometres would be
    # a reason for full braking, which would be a kick, again and again, where nothing but rounding
    # or noise takes a distance there.
    back, stop = -2.0 * (room / limits.dt + rate) / limits.dt, -rate / limits.dt
    if room < 0.0:
        # Where a distance is greatest, levers vanish: the push with them.
        gentle = max(stop, 0.0) + counted * min(1.0, lever / _LEVER)
        wanted = min(wanted, back, gentle, (RECOVERY_SPEED - rate) / limits.dt)
    elif rate < 0.0:
        wanted = min(wanted, max(back, stop))
    wanted -= at_d.bias + min(pushed, 0.0)
    if wanted <= least:
        return False
    rounding = _ROUNDING * (1e-3 + abs(most) + abs(least))
    rows, room = work.rows, room + RESERVE
    rows.lower[k] = min(wanted, most - rounding)
    rows.pair[k], rows.distance[k], rows.rate[k], rows.bias[k] = pair, at_d.d, rate, at_d.bias
    stops = rate >= 0.0 or rate * rate <= 2.0 * braking * room
    rows.viable[k] = room >= 0.0 and stops and wanted <= most + rounding
    return True


@compiled_vectors
def _lowest(room: float, rate: float, braking: float, work: Workspace) -> float:
    """Return the lowest acceleration of a distance that keeps it: that of a joint's lower limit.

    The virtual joint is measured in units in which its braking is 1, so that one table serves.
    """
    table = work.table
    above, below = table.limits[0, 0], table.limits[0, 1]
    bound, _, _ = joint_bounds(room / braking, rate / braking, above, below, table.curves)
    lowest: float = bound * braking
    return lowest


@compiled_vectors
def collision_rows(v: Array, bounds: JointBounds, work: Workspace) -> int:
    """Write the rows of one step, and the pairs' distances; return how many rows there are.

    Args:
        v: joint velocities, shape (n,), rad/s.
        bounds: of the joints.
        work: with the joints' placements and Jacobians at the state; written.
    """
    bodies, pairs, motion, limits = work.bodies, work.pairs, work.motion, work.limits
    place_bodies(bodies, motion)
    _move_joints(v, motion)
    count = 0
    for pair in range(len(pairs.first)):
        i, j = pairs.first[pair], pairs.second[pair]
        speed = _highest_speed(i, j, bodies, motion)
        stopping = limits.dt * speed + speed * speed / limits.braking
        near = max(limits.influence, limits.kept + stopping)
        work.distances[pair] = inf
        if not _too_far(i, j, near, bodies, motion):
            count = _pair_rows(count, pair, near, bounds, work)
    return count


@compiled_vectors
def survey(
    near: float,
    clearance: float,
    pairs: Pairs,
    bodies: Bodies,
    motion: ArmMotion,
    least: Array,
    short: NDArray[np.int64],
) -> None:
    """Take account of one configuration in the choice of pairs.

    Args:
        near: distances beyond it do not matter, m.
        clearance: less is short, m.
        pairs: of bodies.
        bodies: shapes.
        motion: with the joints' placements; written.
        least: least distances so far, shape (p,), m; written.
        short: how often they were short, shape (p,); written.
    """
    place_bodies(bodies, motion)
    for k in range(len(least)):
        i, j = pairs.first[k], pairs.second[k]
        if _too_far(i, j, near, bodies, motion):
            continue
        found = _closest(i, bodies.first[i], j, bodies.first[j], bodies, motion)
        d = found.surface.distance - bodies.radius[i] - bodies.radius[j]
        least[k] = min(least[k], d)
        short[k] += d < clearance
