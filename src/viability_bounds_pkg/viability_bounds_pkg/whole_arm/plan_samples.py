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

STEP = 0
"""Row of the step that leads to a plan."""

FIRST = 1
"""Row of a plan's beginning."""

REST = 10**9
"""Clock of the arm at rest, periods."""


def samples(n: int, smooth: bool) -> int:
    """Return how many samples a plan of n joints has.

    The step that leads to it; those at equal distances; where each joint begins to brake less and
    where it stands, for smooth plans also where it brakes fully; and one at rest.
    """
    return 1 + UNIFORM + (3 if smooth else 2) * n + 1


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
        place, speed = excess_of(j, q[j], v[j], a[j], (N, m, w), limits, dt)
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
