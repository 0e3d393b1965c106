# SPDX-License-Identifier: Apache-2.0
"""Braking plans: every joint slows down until it stands; compiled.

A plan has, for each joint, how many control periods N it moves, in how many of them, m, its
deceleration rises, and in how many, w, it falls again. With a the acceleration of the period
before and d the deceleration between,

    a_k = a (1 - r_k) - d p_k,   r_k = min((k+1)/m, 1),   p_k = min((k+1)/m, 1, (N-k)/w),

for k = 0 .. N-1, and d such that the joint stands after them. Within a period the acceleration is
constant. With m = w = 1 that is one constant deceleration from now until the stop.

After a period, what is left of a plan is the plan with N-1, m-1 and w, at most N-1, from the state
then: the same accelerations. So one plan, once found, is enough for ever.

N is chosen from one time T for the whole arm: a joint takes longer where it would have to brake
harder than A, and less where it would pass its position limit. m and w are as long as it takes for
the acceleration to change gently, where its changes are limited.
"""

from __future__ import annotations

from math import ceil, floor
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from viability_bounds_pkg.compiled import compiled

Array = NDArray[np.float64]
Counts = NDArray[np.int64]

UNIFORM = 20
"""Samples at equal distances in time, the first at the beginning."""

STEP = 0
"""Row of the step that leads to a plan."""

FIRST = 1
"""Row of a plan's beginning."""

REST = 10**9
"""Clock of the arm at rest, periods."""

ROUNDING = 1e-9
"""Of numbers of periods."""

NEGLIGIBLE = 1e-6
"""Excess of speeds and rates, as a share of their limits."""

DRIFTED = 0.2
"""Share of the tolerance by which a plan that is carried on may pass a limit unrepaired."""

HALVINGS = 10
"""Of the search for the largest acceleration from which a joint can stop."""


class Course(NamedTuple):
    """When each joint does what in a plan, in control periods, shape (n,) each."""

    moving: Counts
    """N, until it stands."""
    rising: Counts
    """m, until it brakes fully."""
    falling: Counts
    """w, from full braking to the stop."""


class JointLimitsOfPlans(NamedTuple):
    """What plans keep to, shape (n,) each."""

    q_min: Array
    """Lowest positions at which joints are to stand, rad."""
    q_max: Array
    """Highest, rad."""
    tolerance: Array
    """By how far they may stand beyond, where only braking harder than A would help, rad."""
    v_max: Array
    """Speeds, rad/s; inf for none."""
    braking: Array
    """A, rad/s^2."""
    change_max: Array
    """Change of the acceleration from period to period, rad/s^2; inf for none."""


def new_course(n: int) -> Course:
    """Return the course of n joints that stand after one period."""
    return Course(*(np.ones(n, dtype=np.int64) for _ in range(3)))


def copy_course(course: Course, into: Course) -> None:
    """Copy a course."""
    into.moving[:] = course.moving
    into.rising[:] = course.rising
    into.falling[:] = course.falling


def samples(n: int, smooth: bool) -> int:
    """Return how many samples a plan of n joints has.

    The step that leads to it; those at equal distances; where each joint begins to brake less and
    where it stands, for smooth plans also where it brakes fully; and one at rest.
    """
    return 1 + UNIFORM + (3 if smooth else 2) * n + 1


@compiled
def joint_shape(v: float, a: float, N: int, m: int, w: int, dt: float) -> tuple[float, float]:
    """Return d of one joint, and the change of its acceleration in each period of rising.

    Args:
        v: velocity, rad/s.
        a: acceleration of the period before, rad/s^2.
        N: periods until it stands.
        m: periods of rising.
        w: periods of falling, at most N + 1 - m.
        dt: control period, s.
    """
    d = (v / dt + 0.5 * a * (m - 1)) / (N - 0.5 * (m + w) + 1.0)
    return d, -(a + d) / m


@compiled
def after(
    q: float, v: float, count: float, a: float, change: float, dt: float
) -> tuple[float, float]:
    """Return position and velocity after periods whose acceleration changes at a constant rate.

    Args:
        q: position, rad.
        v: velocity, rad/s.
        count: number of periods.
        a: acceleration in the first period, rad/s^2.
        change: of the acceleration from period to period, rad/s^2.
        dt: control period, s.
    """
    pairs = 0.5 * count * (count - 1.0)
    moved = a * (pairs + 0.5 * count) + change * pairs * ((count - 2.0) / 3.0 + 0.5)
    return q + dt * count * v + dt * dt * moved, v + dt * (a * count + change * pairs)


@compiled
def joint_state(
    q: float, v: float, a: float, N: int, m: int, w: int, dt: float, k: int
) -> tuple[float, float, float]:
    """Return position, velocity and acceleration of one joint at the beginning of period k.

    Linear in (q, v, a). Arguments as of `joint_shape`.
    """
    d, change = joint_shape(v, a, N, m, w, dt)
    if k < m and k < N:
        q, v = after(q, v, k, a + change, change, dt)
        return q, v, a + (k + 1) * change
    q, v = after(q, v, m, a + change, change, dt)
    falls = max(m, N - w + 1)
    if k < falls and k < N:
        q, v = after(q, v, k - m, -d, 0.0, dt)
        return q, v, -d
    q, v = after(q, v, min(falls, N) - m, -d, 0.0, dt)
    begins, change = -d * (N - falls) / w, d / w
    if k < N:
        q, v = after(q, v, k - falls, begins, change, dt)
        return q, v, begins + (k - falls) * change
    q, _ = after(q, v, max(N - falls, 0), begins, change, dt)
    return q, 0.0, 0.0


@compiled
def joint_excess(
    q: float,
    v: float,
    a: float,
    N: int,
    m: int,
    w: int,
    dt: float,
    q_min: float,
    q_max: float,
    v_max: float,
    change_max: float,
) -> tuple[float, float]:
    """Return by how far one joint's plan, or the present state, passes its limits at worst.

    Args:
        q: position, rad.
        v: velocity, rad/s.
        a: acceleration of the period before, rad/s^2.
        N: periods until it stands.
        m: periods of rising.
        w: periods of falling.
        dt: control period, s.
        q_min: lowest position, rad.
        q_max: highest, rad.
        v_max: speed, rad/s.
        change_max: change of the acceleration from period to period, rad/s^2.

    Returns:
        Excess of position, rad; of speed and change of acceleration, as a share of their limits.
    """
    end, _, _ = joint_state(q, v, a, N, m, w, dt, N)
    high, low = max(q, end), min(q, end)
    fast = abs(v) / v_max - 1.0
    if m == 1 and w == 1:
        first = abs(-v / (dt * N) - a)
        change = max(first, abs(v) / (dt * N)) / change_max - 1.0
        return max(high - q_max, q_min - low), max(fast, change)
    d, rising = joint_shape(v, a, N, m, w, dt)
    change = max(abs(rising), abs(d) / w)
    # The acceleration changes its sign once at most, while it rises, before the period `turn`.
    # Until then speed grows or the motion turns round; from then on it only slows down.
    begins = a + rising
    if begins * -d < 0.0:
        turn = min(ceil(-begins / rising), m - 1)
        place, speed = after(q, v, turn, begins, rising, dt)
        high, low = max(high, place), min(low, place)
        fast = max(fast, abs(speed) / v_max - 1.0)
        if v * speed < 0.0:
            near, far = 0, turn  # it stands between
            while far - near > 1:
                middle = (near + far) // 2
                _, between = after(q, v, middle, begins, rising, dt)
                if v * between < 0.0:
                    far = middle
                else:
                    near = middle
            place, speed = after(q, v, near, begins, rising, dt)
            beyond = place + 0.5 * speed * dt  # at most: it stands within this period
            high, low = max(high, beyond), min(low, beyond)
    return max(high - q_max, q_min - low), max(fast, change / change_max - 1.0)


@compiled
def joint_course(
    q: float,
    v: float,
    a: float,
    T: float,
    q_min: float,
    q_max: float,
    tolerance: float,
    braking: float,
    gentle: float,
    dt: float,
) -> tuple[int, int, int]:
    """Return N, m and w of one joint in the plan of time `T`.

    Args:
        q: position, rad.
        v: velocity, rad/s.
        a: acceleration of the period before, rad/s^2.
        T: s.
        q_min: lowest position at which it is to stand, rad.
        q_max: highest, rad.
        tolerance: by how far it may stand beyond where only braking harder than A would help, rad.
        braking: A, rad/s^2.
        gentle: change of the acceleration from period to period, rad/s^2; inf for any.
        dt: control period, s.
    """
    speed = abs(v)
    if gentle == np.inf:
        room = q_max - q if v > 0.0 else q - q_min
        periods = max(ceil(max(T, speed / braking) / dt - ROUNDING), 1)
        if speed > 0.0 and 0.5 * speed * periods * dt > room:
            most = floor(2.0 * max(room, 0.0) / (speed * dt) + ROUNDING)
            beyond = floor(2.0 * max(room + tolerance, 0.0) / (speed * dt) + ROUNDING)
            hardest = ceil(speed / (braking * dt) - ROUNDING)
            periods = max(most, min(hardest, beyond), 1)
        return periods, 1, 1
    wanted = max(ceil(T / dt - ROUNDING), 1)
    best = _gentle_course(v, a, wanted, braking, gentle, dt)
    if _excess(q, v, a, best, q_min, q_max, dt) > 0.0:
        least = 1
        best = _gentle_course(v, a, least, braking, gentle, dt)
        # The longest that stands before the limit; the hardest where none does.
        while wanted - least > 1:
            middle = (least + wanted) // 2
            trial = _gentle_course(v, a, middle, braking, gentle, dt)
            if _excess(q, v, a, trial, q_min, q_max, dt) > 0.0:
                wanted = middle
            else:
                least, best = middle, trial
    return best


@compiled
def _excess(
    q: float,
    v: float,
    a: float,
    course: tuple[int, int, int],
    q_min: float,
    q_max: float,
    dt: float,
) -> float:
    """Return by how far a joint's plan passes its position limits."""
    N, m, w = course
    return joint_excess(q, v, a, N, m, w, dt, q_min, q_max, np.inf, np.inf)[0]


@compiled
def _gentle_course(
    v: float, a: float, wanted: int, braking: float, gentle: float, dt: float
) -> tuple[int, int, int]:
    """Return N, at least as wanted, m and w with which a joint brakes with A at most."""
    N, m, w = wanted, 1, 1
    for _ in range(20):
        impulse = v / dt + 0.5 * a * (m - 1)
        N = max(wanted, ceil(abs(impulse) / braking + 0.5 * (m + w) - 1.0 - ROUNDING), m + w - 1)
        d = impulse / (N - 0.5 * (m + w) + 1.0)
        # They only grow, so it ends; with N they grow less and less.
        rising = max(m, ceil(abs(a + d) / gentle - ROUNDING))
        falling = max(w, ceil(abs(d) / gentle - ROUNDING))
        if rising == m and falling == w:
            break
        m, w = rising, falling
    return N, m, w


@compiled
def make_course(
    q: Array,
    v: Array,
    a: Array,
    T: float,
    gentle: Array,
    limits: JointLimitsOfPlans,
    dt: float,
    course: Course,
) -> None:
    """Fill in the course of the plan of time `T`.

    Args:
        q: positions, shape (n,), rad.
        v: velocities, shape (n,), rad/s.
        a: accelerations of the period before, shape (n,), rad/s^2.
        T: s.
        gentle: change of accelerations from period to period, shape (n,), rad/s^2; inf for any.
        limits: what it keeps to.
        dt: control period, s.
        course: filled in.
    """
    for j in range(q.size):
        course.moving[j], course.rising[j], course.falling[j] = joint_course(
            q[j],
            v[j],
            a[j],
            T,
            limits.q_min[j],
            limits.q_max[j],
            limits.tolerance[j],
            limits.braking[j],
            gentle[j],
            dt,
        )


@compiled
def rest_of(course: Course, rest: Course) -> None:
    """Fill in what is left of a course after a period: at least one."""
    for j in range(course.moving.size):
        rest.moving[j] = max(course.moving[j] - 1, 1)
        rest.rising[j] = max(course.rising[j] - 1, 1)
        rest.falling[j] = min(course.falling[j], rest.moving[j])


@compiled
def repair(
    q: Array,
    v: Array,
    a: Array,
    T: float,
    gentle: Array,
    limits: JointLimitsOfPlans,
    dt: float,
    course: Course,
    repaired: Course,
) -> bool:
    """Fill in a course in which joints that have drifted stand before their limits again.

    Args:
        q: positions, shape (n,), rad.
        v: velocities, shape (n,), rad/s.
        a: accelerations of the period before, shape (n,), rad/s^2.
        T: time of the plan, s.
        gentle: change of accelerations from period to period, shape (n,), rad/s^2.
        limits: of the joints.
        dt: control period, s.
        course: of the plan in hand.
        repaired: filled in: the same, but for joints that end beyond by more than `DRIFTED`.

    Returns:
        Whether there are such joints.
    """
    found = False
    for j in range(q.size):
        N, m, w = course.moving[j], course.rising[j], course.falling[j]
        low, high = limits.q_min[j], limits.q_max[j]
        beyond = _excess(q[j], v[j], a[j], (N, m, w), low, high, dt)
        if beyond > DRIFTED * limits.tolerance[j]:
            found = True
            N, m, w = joint_course(
                q[j],
                v[j],
                a[j],
                T,
                low,
                high,
                limits.tolerance[j],
                limits.braking[j],
                gentle[j],
                dt,
            )
        repaired.moving[j], repaired.rising[j], repaired.falling[j] = N, m, w
    return found


@compiled
def viable_range(
    q: Array,
    v: Array,
    plan: Array,
    last: Array,
    T: float,
    gentle: Array,
    limits: JointLimitsOfPlans,
    dt: float,
    low: Array,
    high: Array,
) -> None:
    """Narrow ranges of accelerations to those after which each joint by itself has a plan.

    Args:
        q: positions, shape (n,), rad.
        v: velocities, shape (n,), rad/s.
        plan: accelerations of the plan in hand, shape (n,), rad/s^2.
        last: accelerations of the period before, shape (n,), rad/s^2.
        T: time of the plans, s.
        gentle: change of accelerations in the plans, shape (n,), rad/s^2.
        limits: of the joints.
        dt: control period, s.
        low: lower ends, shape (n,), rad/s^2; narrowed in place. Where nothing in the range is
            possible, what is nearest to it.
        high: upper ends.
    """
    for j in range(q.size):
        change = limits.change_max[j]
        within = limits.q_min[j] <= q[j] <= limits.q_max[j]
        already = 0.0 if within else np.inf  # then only leave it for the inside
        ends = low[j], high[j]
        for upper in (False, True):
            good, bad = plan[j], last[j] + change if upper else last[j] - change
            if abs(bad) == np.inf:
                bad = max(ends[1], good) if upper else min(ends[0], good)
            if abs(bad) == np.inf:
                continue
            if not within and upper == (q[j] > limits.q_max[j]):
                bad = good
            # The end itself first: mostly it is possible.
            for turn in range(HALVINGS + 1):
                a = bad if turn == 0 else 0.5 * (good + bad)
                place, speed = q[j] + dt * v[j] + 0.5 * dt * dt * a, v[j] + dt * a
                N, m, w = joint_course(
                    place,
                    speed,
                    a,
                    T,
                    limits.q_min[j],
                    limits.q_max[j],
                    limits.tolerance[j],
                    limits.braking[j],
                    gentle[j],
                    dt,
                )
                far, fast = joint_excess(
                    place,
                    speed,
                    a,
                    N,
                    m,
                    w,
                    dt,
                    limits.q_min[j],
                    limits.q_max[j],
                    limits.v_max[j],
                    change,
                )
                if far <= already and fast <= NEGLIGIBLE:
                    good = a
                    if turn == 0:
                        break
                elif turn > 0:
                    bad = a
            if upper:
                high[j] = good
            else:
                low[j] = good
        # Of what is possible what the given range says, or what is nearest to it.
        if abs(low[j]) < np.inf and abs(high[j]) < np.inf:
            possible = low[j], high[j]
            low[j] = min(max(ends[0], possible[0]), possible[1])
            high[j] = max(min(ends[1], possible[1]), possible[0])


@compiled
def fill_clock(course: Course, clock: Counts, order: Counts) -> None:
    """Fill in the periods of a plan's samples, and the samples in their order.

    Args:
        course: of the plan.
        clock: the step that leads to the plan has -1, the last is at rest; shape (samples(n),).
        order: indices by rising clock, shape (samples(n),), or none to be filled in.
    """
    n = course.moving.size
    longest = course.moving.max()
    clock[STEP] = -1
    for k in range(UNIFORM):
        clock[FIRST + k] = (k * longest) // UNIFORM
    corners = FIRST + UNIFORM
    for j in range(n):
        moving = course.moving[j]
        clock[corners + j] = moving - course.falling[j]
        clock[corners + n + j] = moving
        if clock.size > corners + 2 * n + 1:
            clock[corners + 2 * n + j] = course.rising[j] - 1
    clock[-1] = REST
    # Insertion into what is sorted mostly.
    for k in range(order.size):
        place = k
        while place > 0 and clock[order[place - 1]] > clock[k]:
            order[place] = order[place - 1]
            place -= 1
        order[place] = k


@compiled
def fill_plan(
    q: Array,
    v: Array,
    a: Array,
    course: Course,
    limits: JointLimitsOfPlans,
    dt: float,
    clock: Counts,
    order: Counts,
    positions: Array,
    velocities: Array,
    accelerations: Array,
) -> tuple[float, float]:
    """Fill in the states and accelerations of a plan at its samples, but for the step before.

    Args:
        q: positions at its beginning, shape (n,), rad.
        v: velocities, shape (n,), rad/s.
        a: accelerations of the period before, shape (n,), rad/s^2.
        course: of the plan.
        limits: of the joints.
        dt: control period, s.
        clock: filled in, see `fill_clock`.
        order: likewise.
        positions: of the samples, shape (samples(n), n), rad.
        velocities: shape (samples(n), n), rad/s.
        accelerations: shape (samples(n), n), rad/s^2.

    Returns:
        By how far the plan, or the present state, passes limits of joints at worst: excess of
        positions beyond the tolerance, rad; of speeds and changes of acceleration, as a share of
        their limits; 0 for none.
    """
    fill_clock(course, clock, order)
    far = fast = 0.0
    for j in range(q.size):
        N, m, w = course.moving[j], course.rising[j], course.falling[j]
        for k in range(FIRST, clock.size):
            positions[k, j], velocities[k, j], accelerations[k, j] = joint_state(
                q[j], v[j], a[j], N, m, w, dt, min(clock[k], N)
            )
        place, speed = joint_excess(
            q[j],
            v[j],
            a[j],
            N,
            m,
            w,
            dt,
            limits.q_min[j],
            limits.q_max[j],
            limits.v_max[j],
            limits.change_max[j],
        )
        far = max(far, place - limits.tolerance[j])
        fast = max(fast, speed)
    return far, fast if fast > NEGLIGIBLE else 0.0


@compiled
def sensitivity(
    dt: float,
    course: Course,
    clock: int,
    by_q: Array,
    by_v: Array,
    M: Array,
    gradient: Array,
) -> None:
    """Fill in how the torques of a sample change with the acceleration of one control step.

    With the acceleration of the plan, the rest of the plan stays what it is. With another one the
    arm is elsewhere after the step, and brakes from there in the course that is left: the torques
    at the time of the sample change by ``gradient (a - plan)``, to first order.

    Args:
        dt: control period, s.
        course: of the plan from the state in which the step begins.
        clock: period of the sample from then on; of the first, the one after it is meant.
        by_q: derivative of the torque by positions at the sample, shape (n, n).
        by_v: by velocities, shape (n, n).
        M: by accelerations; its upper triangle, shape (n, n).
        gradient: shape (n, n), N m s^2/rad.
    """
    n = course.moving.size
    for j in range(n):
        N = max(course.moving[j] - 1, 1)
        m, w = max(course.rising[j] - 1, 1), min(course.falling[j], N)
        k = min(max(clock - 1, 0), N)
        q_a, v_a, a_a = joint_state(0.5 * dt * dt, dt, 1.0, N, m, w, dt, k)
        for i in range(n):
            inertia = M[i, j] if i <= j else M[j, i]
            gradient[i, j] = by_q[i, j] * q_a + by_v[i, j] * v_a + inertia * a_a
