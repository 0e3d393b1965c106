# SPDX-License-Identifier: Apache-2.0
"""Braking plans: every joint slows down until it stands; compiled.

Each joint has a plan of its own (`joint_plan`): for how many periods N it moves, in how many of
them, m, its deceleration rises, and in how many, w, it falls.

After a period, what is left of a plan is the plan with N-1, m-1 and w, at most N-1, from the state
then: the same accelerations. So one plan, once found, is enough for ever.

N is chosen from one time T for the whole arm: a joint takes longer where it would have to brake
harder than A, and less where it would pass its position limit. m and w are as long as it takes for
the acceleration to change gently, where its changes are limited.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from viability_bounds_pkg.compiled import compiled
from viability_bounds_pkg.whole_arm.joint_plan import (
    joint_course,
    joint_excess,
    joint_state,
    passed,
)

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
def _course_of(
    j: int,
    q: float,
    v: float,
    a: float,
    T: float,
    gentle: Array,
    limits: JointLimitsOfPlans,
    dt: float,
) -> tuple[int, int, int]:
    """Return N, m and w of joint j; see `joint_course`."""
    return joint_course(
        q,
        v,
        a,
        T,
        limits.q_min[j],
        limits.q_max[j],
        limits.tolerance[j],
        limits.braking[j],
        gentle[j],
        dt,
    )


@compiled
def _excess_of(
    j: int,
    q: float,
    v: float,
    a: float,
    course: tuple[int, int, int],
    limits: JointLimitsOfPlans,
    dt: float,
) -> tuple[float, float]:
    """Return by how far the plan of joint j passes its limits; see `joint_excess`."""
    N, m, w = course
    return joint_excess(
        q,
        v,
        a,
        N,
        m,
        w,
        dt,
        limits.q_min[j],
        limits.q_max[j],
        limits.v_max[j],
        limits.change_max[j],
    )


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
        course.moving[j], course.rising[j], course.falling[j] = _course_of(
            j, q[j], v[j], a[j], T, gentle, limits, dt
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
        beyond = passed(q[j], v[j], a[j], (N, m, w), low, high, dt)
        if beyond > DRIFTED * limits.tolerance[j]:
            found = True
            N, m, w = _course_of(j, q[j], v[j], a[j], T, gentle, limits, dt)
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
                course = _course_of(j, place, speed, a, T, gentle, limits, dt)
                far, fast = _excess_of(j, place, speed, a, course, limits, dt)
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
        place, speed = _excess_of(j, q[j], v[j], a[j], (N, m, w), limits, dt)
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
