"""One distance becomes a row on the joint accelerations, compiled.

`docs/collision_avoidance.md` derives the formulas: d'' = G a + bias along the motion, and the
lowest d'' from which the distance can be kept, as for the lower limit of a joint.
"""

from __future__ import annotations

from math import sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torque_safety_controller.collision.kinematics import point_motion
from torque_safety_controller.collision.vectors3 import at, compiled, cross, dot, sub
from viability_bounds_pkg.kernel.bounds_kernel import joint_bounds

Array = NDArray[np.float64]

_BLUNT = 1e-3  # m; axes nearer than this have met, and no curvature is told any more
# Squared sine of the angle between two segments, or a segment and a face, below which the
# closest points slide so fast that the rows of the ends take over.
_PARALLEL = 1e-2
_LEAST_BRAKING = 1e-2  # m/s^2
_LEAST_SHARE = 0.1
_LEVER = 0.1  # m/rad
_ROUNDING = 1e-9


class Law(NamedTuple):
    """Numbers of `collision_avoidance.CollisionSettings`, as the kernels read them."""

    margin: float
    reserve: float
    braking: float
    share: float
    speed_max: float
    recovery_speed: float
    influence: float
    dt: float


class Rows(NamedTuple):
    """Room for the rows of a step, and for the search that leads to them.

    Attributes:
        G: shape (k, n), m/rad.
        lower: shape (k,), m/s^2.
        pair: that a row belongs to, shape (k,), int.
        distance: shape (k,), m.
        rate: its rate of change, shape (k,), m/s.
        bias: its acceleration at zero joint acceleration, shape (k,), m/s^2.
        viable: whether the margin is kept and can be, shape (k,), bool.
        found: distance of each pair, inf where it is too far to matter, shape (p,), m.
        start: of the capsules in the base frame, shape (c, 3), m.
        segment: from there to their ends, shape (c, 3), m.
        free: directions in which closest points are free to slide, shape (3, 3).
        turning: angular velocity of each of them, shape (3, 3), rad/s.
        factor: scratch, shape (4, 3).
        seen: features of the pair that have a row, shape (16, 4).
        count: rows written, and features seen of the pair at hand, shape (2,), int.
    """

    G: Array
    lower: Array
    pair: NDArray[np.int64]
    distance: Array
    rate: Array
    bias: Array
    viable: NDArray[np.bool_]
    found: Array
    start: Array
    segment: Array
    free: Array
    turning: Array
    factor: Array
    seen: Array
    count: NDArray[np.int64]


class Step(NamedTuple):
    """What the rows of one step depend on besides the motion.

    Attributes:
        a_lower: shape (n,), rad/s^2.
        a_upper: shape (n,), rad/s^2.
        disturbance: what comes on top of accelerations that are asked for, shape (n,), rad/s^2.
        a_brake: what each joint can brake with, shape (n,), rad/s^2.
        limits: of the virtual joint whose braking is 1, see `one_sided_limit.JointTable`.
        curves: of that joint.
        law: of the distances.
    """

    a_lower: Array
    a_upper: Array
    disturbance: Array
    a_brake: Array
    limits: NDArray[np.void]
    curves: NDArray[np.void]
    law: Law


def make_rows(most: int, n: int, pairs: int, capsules: int) -> Rows:
    """Return room for up to `most` rows of n joints."""
    return Rows(
        G=np.zeros((most, n)),
        lower=np.zeros(most),
        pair=np.zeros(most, dtype=np.int64),
        distance=np.zeros(most),
        rate=np.zeros(most),
        bias=np.zeros(most),
        viable=np.zeros(most, dtype=bool),
        found=np.full(pairs, np.inf),
        start=np.zeros((capsules, 3)),
        segment=np.zeros((capsules, 3)),
        free=np.zeros((3, 3)),
        turning=np.zeros((3, 3)),
        factor=np.zeros((4, 3)),
        seen=np.zeros((16, 4)),
        count=np.zeros(2, dtype=np.int64),
    )


@compiled
def write_row(pair, d, radius, n, p, joint, o, other, sliding, step, chain, motion, rows):
    """Write the next row, for one distance, unless the bounds imply it.

    Args:
        pair: that it belongs to.
        d: distance of two points, m; from it `radius` is taken off.
        radius: m.
        n: unit vector from the second point to the first.
        p: point of the first body.
        joint: that moves it.
        o: point of the second body.
        other: joint that moves that; 0 for what stands still.
        sliding: how many of `Rows.free` are set; -1 when the normal stands still, too.
        step: bounds and law.
        chain: constants of the joints.
        motion: of the joints.
        rows: to write to.
    """
    law = step.law
    v, gamma = point_motion(motion, joint, p)
    if other > 0:
        v_other, gamma_other = point_motion(motion, other, o)
        v, gamma = sub(v, v_other), sub(gamma, gamma_other)
    rate, bias = dot(n, v), dot(n, gamma)
    if sliding >= 0 and d > _BLUNT:
        c = (d * n[0], d * n[1], d * n[2])
        bias += (
            dot(v, v)
            - rate * rate
            - _sliding_term(v, c, sliding, rows.free, rows.turning, rows.factor)
        ) / d
    k = rows.count[0]
    G = rows.G[k]
    brake, most, least, pushed = 0.0, 0.0, 0.0, 0.0
    axes, origins, slides = motion.axis, motion.origin, chain.slides
    moves, moves_other = chain.moved_by[joint], chain.moved_by[other]
    a_lower, a_upper, a_brake = step.a_lower, step.a_upper, step.a_brake
    for m in range(len(G)):
        g = 0.0
        if moves[m]:
            g = _lever(at(axes, m + 1), at(origins, m + 1), slides[m + 1], p, n)
        if moves_other[m]:
            g -= _lever(at(axes, m + 1), at(origins, m + 1), slides[m + 1], o, n)
        G[m] = g
        brake += abs(g) * a_brake[m]
        pushed += g * step.disturbance[m]
        low, high = g * a_lower[m], g * a_upper[m]
        most += max(low, high)
        least += min(low, high)
    # A bias towards the other body takes from the braking, but it falls with the speed squared.
    braking = min(law.braking, law.share * brake)
    braking = max(min(braking, law.share * brake + bias), _LEAST_SHARE * braking, _LEAST_BRAKING)
    room = d - radius - law.margin - law.reserve
    wanted = _lowest(room, rate, braking, step)
    if room < 0.0:
        gentle = min(law.braking, law.share * brake) * min(1.0, _largest(G) / _LEVER)
        wanted = min(wanted, _recovery(room, rate, gentle, law))
    elif rate < 0.0:
        wanted = min(wanted, max(_back(room, rate, law), -rate / law.dt))
    wanted -= bias + min(pushed, 0.0)
    if wanted <= least:
        return
    rounding = _ROUNDING * (1e-3 + abs(most) + abs(least))
    rows.lower[k] = min(wanted, most - rounding)
    rows.pair[k] = pair
    rows.distance[k] = d - radius
    rows.rate[k] = rate
    rows.bias[k] = bias
    room += law.reserve
    stops = rate >= 0.0 or rate * rate <= 2.0 * braking * room
    rows.viable[k] = room >= 0.0 and stops and wanted <= most + rounding
    rows.count[0] = k + 1


@compiled
def _lever(axis, origin, slides, p, n):
    """Return the speed along n that a unit velocity of a joint gives to a point that it moves."""
    return dot(axis, n) if slides else dot(axis, cross(sub(p, origin), n))


@compiled
def _sliding_term(v, c, count, free, turning, L):
    """Return what sliding takes off the second derivative of |c|^2 / 2: w' H^-1 w.

    H_ij = e_i . e_j and w_i = v . e_i + c . e_i', for unit vectors e_i; by elimination.

    Args:
        v: rate of change of c where nothing slides.
        c: from one closest point to the other.
        count: number of directions e_i.
        free: these, as rows.
        turning: the angular velocity of each.
        L: scratch, shape (4, 3).
    """
    w = L[3]
    total = 0.0
    for i in range(count):
        e = at(free, i)
        w[i] = dot(v, e) + dot(c, cross(at(turning, i), e))
        pivot = 1.0
        for j in range(i):
            x = dot(e, at(free, j))
            for m in range(j):
                x -= L[i, m] * L[j, m] * L[m, m]
            L[i, j] = x / L[j, j]
            pivot -= L[i, j] * x
            w[i] -= L[i, j] * w[j]
        L[i, i] = max(pivot, _PARALLEL)
        total += w[i] * w[i] / L[i, i]
    return total


@compiled
def _lowest(room, rate, braking, step):
    """Return the lowest acceleration of a distance that keeps it: that of a joint's lower limit.

    The virtual joint is measured in units in which its braking is 1, so that one table serves.
    """
    above, below = step.limits[0, 0], step.limits[0, 1]
    lower, _, _ = joint_bounds(room / braking, rate / braking, above, below, step.curves)
    law = step.law
    return max(lower * braking, (-law.speed_max - rate) / law.dt)


@compiled
def _largest(G):
    """Return the largest lever: where a distance is greatest they vanish, and so does the push."""
    lever = 0.0
    for g in G:
        lever = max(lever, abs(g))
    return lever


@compiled
def _back(room, rate, law):
    """Return the acceleration with which a distance is at its limit after a step.

    More is never asked for where it approaches its limit or is beyond it, but to end the
    approach: the last micrometres would be a reason for full braking, which would be a kick,
    again and again, where nothing but rounding or noise takes a distance there.
    """
    return -2.0 * (room / law.dt + rate) / law.dt


@compiled
def _recovery(room, rate, gentle, law):
    """Return the acceleration of a distance beyond its limit with which it gets back well enough.

    The approach ends at once; then it accelerates by `gentle`, up to the speed of recovery.
    """
    stop = max(-rate, 0.0) / law.dt
    return min(_back(room, rate, law), stop + gentle, (law.recovery_speed - rate) / law.dt)


@compiled
def slides_along(count, direction, turning, free, turns):
    """Add a direction to those in which closest points may slide; return how many there are."""
    length = sqrt(dot(direction, direction))
    for k in range(3):
        free[count, k] = direction[k] / length
        turns[count, k] = turning[k]
    return count + 1
