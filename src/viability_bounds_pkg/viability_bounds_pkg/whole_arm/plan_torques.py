# SPDX-License-Identifier: Apache-2.0
"""Torques along a braking plan, at all of its samples at once."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from viability_bounds_pkg.compiled import compiled
from viability_bounds_pkg.state import State
from viability_bounds_pkg.whole_arm.braking_plan import (
    Counts,
    Course,
    JointLimitsOfPlans,
    copy_course,
    make_course,
    new_course,
)
from viability_bounds_pkg.whole_arm.plan_samples import (
    FIRST,
    STEP,
    fill_plan,
    samples,
)

Array = NDArray[np.float64]

RATE_RESERVE = 0.1
"""Share of the limits of the torques' rates that plans leave, for what lies between samples."""


class PlanTorques:
    """The plan that was looked at last, its torques and what they leave of the limits.

    Arrays have one row for each sample, `count` of them filled in, the last for the arm at rest;
    and a column for each of the n joints.

    Args:
        model: the arm, n joints with one coordinate each.
        limits: what plans keep to.
        tau_max: torque that the plans may use, shape (n,), N m.
        tau_change: change of torque in a period that they may use, shape (n,), N m; inf for none.
        dt: control period, s.

    Attributes:
        course: when each joint does what.
        count: number of samples.
        clock: periods of the samples, rising; -1 for the step that leads to the plan.
        positions: rad.
        velocities: rad/s.
        accelerations: rad/s^2.
        tau: torques that are needed, N m.
        loads: largest torque of each joint along the plan, as a share of its limit, shape (n,).
        changes: largest change of torque likewise.
        busiest: samples after the first at which most of each is needed, shape (n,).
        slack: least share that the plan leaves of a torque limit; negative beyond it.
        beyond: by how far a position limit is passed, less the tolerance, rad; 0 where none is.
        excess: by which share a limit of speed or of the change of acceleration is passed; 0 where
            none is.
        hurry: by which share the torques change too fast; 0 where they do not.
    """

    def __init__(
        self,
        model: pin.Model,
        limits: JointLimitsOfPlans,
        tau_max: Array,
        tau_change: Array,
        dt: float,
    ) -> None:
        n = model.nv
        rates = bool(np.isfinite(tau_change).any())
        self._smooth = rates or bool(np.isfinite(limits.change_max).any())
        most = self.count = samples(n, self._smooth)
        self._limits, self._tau_max, self._tau_change, self._dt = limits, tau_max, tau_change, dt
        self._pool = pin.ModelPool(model, 1)
        self.course = new_course(n)
        self.clock = np.zeros(most, dtype=np.int64)
        self.positions, self.velocities, self.accelerations, self.tau = rows = [
            np.zeros((most, n)) for _ in range(4)
        ]
        # Pinocchio has a column for each sample; by their number.
        self._columns = [tuple(each[:count].T for each in rows) for count in range(most + 1)]
        self.loads, self.changes = np.zeros(n), np.zeros(n)
        self.busiest = np.zeros(n, dtype=np.int64)
        self.slack = self.beyond = self.excess = self.hurry = 0.0

    def plan(
        self,
        q: Array,
        v: Array,
        a: Array,
        T: float,
        gentle: Array,
        extra: Array,
        step: State | None = None,
    ) -> None:
        """Make the plan of time `T`, s, and `follow` it; `gentle` as in `braking_plan`."""
        make_course(q, v, a, T, gentle, self._limits, self._dt, self.course)
        self.follow(q, v, a, self.course, extra, step)

    def follow(
        self,
        q: Array,
        v: Array,
        a: Array,
        course: Course,
        extra: Array,
        step: State | None = None,
    ) -> None:
        """Compute the plan of a given course, and what it leaves of the limits.

        q, v and a are as in `braking_plan`. `extra` is the torque that the motors give besides,
        shape (n,), N m; `step` is the state in which the period before began, None if the plan
        begins now.
        """
        if course is not self.course:
            copy_course(course, self.course)
        self.count, self.beyond, self.excess = fill_plan(
            q,
            v,
            a,
            course,
            self._limits,
            self._dt,
            self._smooth,
            self.clock,
            self.positions,
            self.velocities,
            self.accelerations,
        )
        if step is not None:
            self.positions[STEP], self.velocities[STEP] = step
            self.accelerations[STEP] = a
        else:
            for rows in (self.positions, self.velocities, self.accelerations):
                rows[STEP] = rows[FIRST]
        pin.rneaInParallel(1, self._pool, *self._columns[self.count])
        self.slack, self.hurry = measure(
            self.tau,
            extra,
            self._tau_max,
            self._tau_change,
            self.clock,
            self.count,
            self.loads,
            self.changes,
            self.busiest,
        )

    @property
    def at_rest(self) -> int:
        """Row of the arm at rest."""
        return self.count - 1

    @property
    def cost(self) -> float:
        """How much of the limits the plan needs, of all joints together."""
        loads, changes = self.loads * self.loads, self.changes * self.changes
        return float(loads @ loads + changes @ changes)


@compiled
def measure(
    tau: Array,
    extra: Array,
    tau_max: Array,
    tau_change: Array,
    clock: Counts,
    count: int,
    loads: Array,
    changes: Array,
    busiest: Counts,
) -> tuple[float, float]:
    """Add `extra` to torques in place, and compare them with their limits.

    Args:
        tau: torques at the samples, shape (k, n), N m.
        extra: shape (n,), N m.
        tau_max: shape (n,), N m.
        tau_change: largest change in a period, shape (n,), N m.
        clock: periods of the samples, rising, shape (k,).
        count: how many of the samples there are, at most k.
        loads: largest share of each joint's limit, shape (n,), filled in.
        changes: largest share of what may change, shape (n,), filled in.
        busiest: the sample after the first with the largest torque of each joint, filled in.

    Returns:
        1 less the largest share of a torque limit; and by which share a change is too large, or 0.
    """
    n = tau_max.size
    most = hurry = 0.0
    for j in range(n):
        loads[j] = -1.0
        busiest[j] = count - 1
        changes[j] = 0.0
        tau[STEP, j] += extra[j]
    for k in range(count - 1, FIRST - 1, -1):
        for j in range(n):
            tau[k, j] += extra[j]
            load = abs(tau[k, j]) / tau_max[j]
            # Written so that a NaN counts as too much.
            if not load <= loads[j]:
                loads[j] = load
                if k > FIRST:
                    busiest[j] = k
    for j in range(n):
        if not loads[j] <= most:
            most = loads[j]
        if tau_change[j] == np.inf:
            continue
        for k in range(FIRST, count - 1):  # but for the last, the arm at rest
            change = abs(tau[k, j] - tau[k - 1, j])
            change /= tau_change[j] * (clock[k] - clock[k - 1])
            if not change <= changes[j]:
                changes[j] = change
        if not changes[j] <= hurry:
            hurry = changes[j]
    return 1.0 - most, max(hurry - 1.0, 0.0)
