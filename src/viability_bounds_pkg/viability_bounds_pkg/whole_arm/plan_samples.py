# SPDX-License-Identifier: Apache-2.0
"""States of a braking plan at samples in time, at which its torques are computed; compiled."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from viability_bounds_pkg.compiled import compiled
from viability_bounds_pkg.whole_arm.braking_plan import (
    NEGLIGIBLE,
    Counts,
    Course,
    JointLimitsOfPlans,
    excess_of,
)
from viability_bounds_pkg.whole_arm.joint_plan import joint_state

Array = NDArray[np.float64]

UNIFORM = 20
"""Samples at equal distances in time, the first at the beginning."""

UNIFORM_SMOOTH = 40
"""The same where changes are limited: torques change faster between samples than on average."""

STEP = 0
"""Row of the step that leads to a plan."""

FIRST = 1
"""Row of a plan's beginning."""

REST = 10**9
"""Clock of the arm at rest, periods."""


def samples(n: int, smooth: bool) -> int:
    """Return how many samples a plan of n joints has at most.

    The step that leads to it; those at equal distances; where each joint begins to brake less and
    where it stands, for smooth plans also where it brakes fully; and one at rest.
    """
    return 1 + (UNIFORM_SMOOTH + 3 * n if smooth else UNIFORM + 2 * n) + 1


@compiled
def fill_clock(course: Course, smooth: bool, clock: Counts) -> int:
    """Fill in the periods of a plan's samples, in their order, each once; return how many.

    Args:
        course: of the plan.
        smooth: whether there are samples where joints brake fully.
        clock: the step that leads to the plan has -1, the last is at rest; shape
            (samples(n, smooth),).
    """
    clock[STEP] = -1
    clock[FIRST] = 0
    count = FIRST + 1
    longest = course.moving.max()
    uniform = UNIFORM_SMOOTH if smooth else UNIFORM
    for k in range(1, uniform):
        period = (k * longest) // uniform
        if period > clock[count - 1]:
            clock[count] = period
            count += 1
    for j in range(course.moving.size):
        moving = course.moving[j]
        count = insert(moving - course.falling[j], clock, count)
        count = insert(moving, clock, count)
        if smooth:
            count = insert(course.rising[j] - 1, clock, count)
    clock[count] = REST
    return count + 1


@compiled
def insert(period: int, clock: Counts, count: int) -> int:
    """Insert a period into the first `count`, which are sorted; return how many there are now."""
    place = count
    while clock[place - 1] > period:
        place -= 1
    if clock[place - 1] == period:
        return count
    for k in range(count, place, -1):
        clock[k] = clock[k - 1]
    clock[place] = period
    return count + 1


@compiled
def fill_plan(
    q: Array,
    v: Array,
    a: Array,
    course: Course,
    limits: JointLimitsOfPlans,
    dt: float,
    smooth: bool,
    clock: Counts,
    positions: Array,
    velocities: Array,
    accelerations: Array,
) -> tuple[int, float, float]:
    """Fill in the states and accelerations of a plan at its samples, but for the step before.

    The clock is filled in as by `fill_clock`, and so are arrays of shape (samples(n, smooth), n):
    positions, rad, velocities, rad/s, accelerations, rad/s^2. Others are as in `braking_plan`.

    Returns:
        How many samples there are; by how far the plan, or the present state, passes limits of
        joints at worst: excess of positions beyond the tolerance, rad; of speeds and changes of
        acceleration, as a share of their limits; 0 for none.
    """
    count = fill_clock(course, smooth, clock)
    far = fast = 0.0
    for j in range(q.size):
        N, m, w = course.moving[j], course.rising[j], course.falling[j]
        for k in range(FIRST, count):
            positions[k, j], velocities[k, j], accelerations[k, j] = joint_state(
                q[j], v[j], a[j], N, m, w, dt, min(clock[k], N)
            )
        place, speed = excess_of(j, q[j], v[j], a[j], (N, m, w), limits, dt)
        far = max(far, place - limits.tolerance[j])
        fast = max(fast, speed)
    return count, far, fast if fast > NEGLIGIBLE else 0.0


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
