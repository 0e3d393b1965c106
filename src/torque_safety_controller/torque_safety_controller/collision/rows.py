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

from torque_safety_controller.collision.distances import Closest, Pairs, closest, is_far
from torque_safety_controller.collision.motion import (
    ArmMotion,
    Bodies,
    at_point,
    move_joints,
    place_bodies,
)
from torque_safety_controller.collision.vectors3 import (
    Vector,
    along,
    at,
    column,
    compiled_vectors,
    cross,
    dot,
    sub,
    times,
)
from viability_bounds_pkg.kernel import joint_bounds

Array = NDArray[np.float64]

RESERVE = 0.002
"""Kept on top of the margin for what the linearisation within a step may take, m."""

BRAKING = 2.0
"""Deceleration that a distance counts on at most, m/s^2."""

BRAKING_SHARE = 0.3
"""Share of what the joints can do along a distance that it counts on, up to `BRAKING`."""

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
    """Arguments and results of `collision_rows`.

    Attributes:
        bodies, pairs: of the collision model.
        motion: of both, with the joints' placements and Jacobians at the state.
        kept: distance to keep, margin and `RESERVE`, m.
        speed_max: greatest speed of approach, m/s.
        influence: distance beyond which only fast approach matters, m.
        dt: how long an acceleration is held, s.
        table: of a virtual joint whose braking is 1.
        braking: what each joint can brake with, shape (n,), rad/s^2.
        v: joint velocities, shape (n,), rad/s.
        a_lower, a_upper: bounds of the accelerations, shape (n,), rad/s^2.
        disturbance: on top of accelerations that are asked for, shape (n,), rad/s^2.
        rows: results.
        distances: of the pairs, shape (p,), m; inf for what is too far to matter.
        seen: closest points of the pair at hand that have a row, shape (16, 2, 3), m.
    """

    bodies: Bodies
    pairs: Pairs
    motion: ArmMotion
    kept: float
    speed_max: float
    influence: float
    dt: float
    table: NDArray[np.void]
    braking: Array
    v: Array
    a_lower: Array
    a_upper: Array
    disturbance: Array
    rows: CollisionRows
    distances: Array
    seen: Array


@compiled_vectors
def _highest_speed(i: int, j: int, bodies: Bodies, motion: ArmMotion) -> float:
    """Return at least the speed with which two bodies approach each other."""
    first, second = motion.velocity[bodies.joint[i]], motion.velocity[bodies.joint[j]]
    v = sub(at_point(first, at(motion.centre, i)), at_point(second, at(motion.centre, j)))
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
def _pair_rows(k: int, pair: int, near: float, work: Workspace) -> int:
    """Write the rows of a pair from row `k` on, and its distance; return the next row."""
    bodies, motion = work.bodies, work.motion
    i, j = work.pairs.first[pair], work.pairs.second[pair]
    first, second, end = bodies.first[i], bodies.first[j], bodies.first[j + 1]
    radius, count = bodies.radius[i] + bodies.radius[j], 0
    for part in range(first, bodies.first[i + 1]):
        for other in range(second, end if part == first else second + 1):
            found = closest(i, part, j, other, bodies, motion)
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
            if _write_row(k, pair, d - radius, rate, bias, n, o, work):
                k += 1
    return k


@compiled_vectors
def _rate_and_bias(
    i: int, j: int, found: Closest, n: Vector, o: Vector, slides: bool, bodies: Bodies,
    motion: ArmMotion,
) -> tuple[float, float]:  # fmt: skip
    """Return the rate of a distance, and its acceleration at zero joint acceleration.

    Of capsule `i` and body `j`, with their closest points `found`; `n` is the unit vector from
    the second to the first, `o` the closest point of the second. `slides` tells whether the
    closest point may slide along the capsule.
    """
    first, second, d = bodies.joint[i], bodies.joint[j], found.surface.distance
    turning, turning_other = at(motion.velocity[first], 1), at(motion.velocity[second], 1)
    v = at_point(motion.velocity[first], found.point)
    v_other = at_point(motion.velocity[second], o)
    gamma = sub(
        along(at_point(motion.bias[first], found.point), 1.0, cross(turning, v)),
        along(at_point(motion.bias[second], o), 1.0, cross(turning_other, v_other)),
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
def _write_row(
    k: int, pair: int, d: float, rate: float, bias: float, n: Vector, o: Vector, work: Workspace
) -> bool:
    """Write row `k` for a distance `d` along `n` through `o`, unless the bounds imply it.

    Returns whether it was written.
    """
    J, moves, rows, table = work.motion.J, work.pairs.moves[pair], work.rows, work.table
    G, moment, dt = rows.G[k], cross(o, n), work.dt
    brake, most, least, pushed, lever = 0.0, 0.0, 0.0, 0.0, 0.0
    for m in range(len(G)):
        g = 0.0
        if moves[m] != 0.0:
            g = moves[m] * (dot(n, at(J[m], 0)) + dot(moment, at(J[m], 1)))
        G[m] = g
        brake += abs(g) * work.braking[m]
        pushed += g * work.disturbance[m]
        low, high = g * work.a_lower[m], g * work.a_upper[m]
        most += max(low, high)
        least += min(low, high)
        lever = max(lever, abs(g))
    # A bias towards the other body takes from the braking, but it falls with the speed squared.
    share = BRAKING_SHARE * brake
    counted = min(BRAKING, share)
    braking = max(min(counted, share + bias), _LEAST_SHARE * counted, _LEAST_BRAKING)
    room = d - work.kept
    # As a joint's lower limit, in units in which its braking is 1, so that one table serves.
    above, below = table[0, 0], table[0, 1]
    lowest, _, _ = joint_bounds(room / braking, rate / braking, above, below)
    wanted = max(braking * lowest, (-work.speed_max - rate) / dt)
    # With which the distance is at its limit after a step. More is never asked for where it
    # approaches its limit or is beyond it, but to end the approach: the last micrometres would be
    # a reason for full braking, which would be a kick, again and again, where nothing but rounding
    # or noise takes a distance there.
    back, stop = -2.0 * (room / dt + rate) / dt, -rate / dt
    if room < 0.0:
        # Where a distance is greatest, levers vanish: the push with them.
        gentle = max(stop, 0.0) + counted * min(1.0, lever / _LEVER)
        wanted = min(wanted, back, gentle, (RECOVERY_SPEED - rate) / dt)
    elif rate < 0.0:
        wanted = min(wanted, max(back, stop))
    wanted -= bias + min(pushed, 0.0)
    if wanted <= least:
        return False
    rounding = _ROUNDING * (1e-3 + abs(most) + abs(least))
    room += RESERVE
    rows.lower[k] = min(wanted, most - rounding)
    rows.pair[k], rows.distance[k], rows.rate[k], rows.bias[k] = pair, d, rate, bias
    stops = rate >= 0.0 or rate * rate <= 2.0 * braking * room
    rows.viable[k] = room >= 0.0 and stops and wanted <= most + rounding
    return True


@compiled_vectors
def collision_rows(work: Workspace) -> int:
    """Write the rows of one step, and the pairs' distances; return how many rows there are."""
    bodies, pairs, motion = work.bodies, work.pairs, work.motion
    place_bodies(bodies, motion)
    move_joints(work.v, motion)
    count = 0
    for pair in range(len(pairs.first)):
        i, j = pairs.first[pair], pairs.second[pair]
        speed = _highest_speed(i, j, bodies, motion)
        near = max(work.influence, work.kept + work.dt * speed + speed * speed / BRAKING)
        work.distances[pair] = inf
        if not is_far(i, j, near, bodies, motion):
            count = _pair_rows(count, pair, near, work)
    return count
