# SPDX-License-Identifier: Apache-2.0
"""Braking plans: every joint slows down until it stands; compiled.

Each joint has a plan of its own (`joint_plan`): for how many periods N it moves, in how many of
them, m, its deceleration rises, and in how many, w, it falls.

After a period, what is left of a plan is the plan with N-1, m-1 and w, at most N-1, from the state
then: the same accelerations. So one plan, once found, is enough for ever.

N is chosen from one time T for the whole arm: a joint takes longer where it would have to brake
harder than A, and less where it would pass its position limit. m and w are as long as it takes for
the acceleration to change gently, where its changes are limited.

Arguments, for n joints, arrays of shape (n,): positions q, rad, and velocities v, rad/s, at the
beginning of a plan; accelerations a of the period before, rad/s^2; the time T of the plan and the
control period dt, s; the change of acceleration from period to period that is `gentle`, rad/s^2,
inf for any. Functions of one joint, j, take its own q, v and a.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from viability_bounds_pkg.compiled import compiled
from viability_bounds_pkg.whole_arm.joint_plan import (
    joint_course,
    joint_excess,
    passed,
)

Array = NDArray[np.float64]
Counts = NDArray[np.int64]

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
def excess_of(
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
    """Fill in the course of the plan of time `T`."""
    for j in range(q.size):
        course.moving[j], course.rising[j], course.falling[j] = _course_of(
            j, q[j], v[j], a[j], T, gentle, limits, dt
        )


def rest_of(course: Course, rest: Course) -> None:
    """Fill in what is left of a course after a period: at least one."""
    np.maximum(course.moving - 1, 1, out=rest.moving)
    np.maximum(course.rising - 1, 1, out=rest.rising)
    np.minimum(course.falling, rest.moving, out=rest.falling)


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
    """Return whether joints have drifted: their plan ends beyond a limit by more than `DRIFTED`.

    Then `repaired` is filled in: `course`, that of the plan in hand, but for these joints, which
    stand before their limits again.
    """
    beyond = np.empty(q.size)
    for j, (N, m, w) in enumerate(zip(*course, strict=True)):
        low, high = limits.q_min[j], limits.q_max[j]
        beyond[j] = passed(q[j], v[j], a[j], (N, m, w), low, high, dt)
    fine = ~(beyond > DRIFTED * limits.tolerance)
    if fine.all():
        return False
    make_course(q, v, a, T, gentle, limits, dt, repaired)
    for new, old in zip(repaired, course, strict=True):
        new[fine] = old[fine]
    return True


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

    `low` and `high`, the ends of the ranges, rad/s^2, change in place; where nothing in a range is
    possible, to what is nearest to it. `plan` has the accelerations of the plan in hand, `last`
    those of the period before, rad/s^2.
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
                far, fast = excess_of(j, place, speed, a, course, limits, dt)
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
