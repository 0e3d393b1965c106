# SPDX-License-Identifier: Apache-2.0
"""Torque limits of a braking plan as linear constraints on the acceleration of this step."""

from __future__ import annotations

from math import sqrt

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from torque_safety_controller.parts.whole_arm.braking_plan import FIRST, BrakingPlans
from torque_safety_controller.qp import LinearConstraints

Array = NDArray[np.float64]

KEPT = 0.01
"""Further share that the constraints on a step leave, so that its trial seldom fails."""

START_SHARE = 0.002
"""What the torque of the step itself may use of that: else an arm that stands where it leaves no
more could not even start to move away from there."""

NEAR = 0.6
"""Share of a torque limit above which a plan's torque constrains the step."""

APPROACH_TIME = 0.04
"""Time constant with which a step may use up what a plan leaves of a torque limit, s."""

RETURN_TIME = 0.12
"""Time constant with which a step leads back to what a plan is to leave, s: gently, because noise
of the states moves plans as well."""


class PlanRows:
    """Constraints by which a step leaves a plan its torques, to first order.

    Args:
        model: the arm, n joints with one coordinate each; it may change.
        usable: torque that plans may use, shape (n,), N m.
        dt: control period, s.
    """

    def __init__(self, model: pin.Model, usable: Array, dt: float) -> None:
        n = model.nv
        self._model, self._data, self._usable, self._dt = model, model.createData(), usable, dt
        self._upper_triangle = np.triu(np.ones((n, n), dtype=bool))  # all that Pinocchio gives

    def of(self, plans: BrakingPlans, chosen: int) -> LinearConstraints | None:
        """Return rows for joints of large torque: at first, when it is largest, and at rest.

        None where all torques are far from their limits. The plan's own acceleration keeps the
        rows.

        Args:
            plans: from the present state.
            chosen: index of the one that counts.
        """
        loads, dt = plans.loads[chosen], self._dt
        # With fewer samples the largest torque would move to and fro between them.
        busiest = loads[FIRST + 1 :].argmax(axis=0) + FIRST + 1
        last = len(loads) - 1
        joints: dict[int, list[int]] = {}
        for j in np.flatnonzero(plans.peaks[chosen] > NEAR).tolist():
            for k in {FIRST, int(busiest[j]), last}:
                if loads[k, j] > NEAR:
                    joints.setdefault(k, []).append(j)
        rows, upper = [], []
        clock, q, v, a = (each[chosen] for each in plans.samples)
        plan = a[FIRST]
        for k, own in joints.items():
            by_q, by_v, M = pin.computeRNEADerivatives(self._model, self._data, q[k], v[k], a[k])
            M = np.where(self._upper_triangle, M, M.T)
            change = torque_change(clock[k], plans.periods[chosen], by_q, by_v, M, dt)
            for j in own:
                tau = plans.tau[chosen, k, j]
                row = change[j] if tau > 0.0 else -change[j]
                kept = KEPT if k != FIRST else KEPT - START_SHARE
                left = (1.0 - kept) * self._usable[j] - abs(tau)
                size = max(sqrt(row @ row), 1e-9)
                share = min(dt / (APPROACH_TIME if left > 0.0 else RETURN_TIME), 1.0)
                rows.append(row / size)
                upper.append((share * left + float(row @ plan)) / size)
        if not rows:
            return None
        return LinearConstraints(np.array(rows), np.full(len(rows), -np.inf), np.array(upper))


def torque_change(
    clock: float, periods: Array, by_q: Array, by_v: Array, M: Array, dt: float
) -> Array:
    """Return how the torques at a sample change with the acceleration of this control step.

    With the acceleration of the plan, the rest of the plan stays what it is. With another one the
    arm is elsewhere after the step, and brakes from there in the periods that are left: the
    torques at the time of the sample change by ``result @ (a - plan)``, to first order.

    Args:
        clock: of the sample, periods from the beginning of the step; at least 1 is assumed.
        periods: of the plan from the state in which the step begins, shape (n,).
        by_q: derivative of the torque by positions at the sample, shape (n, n).
        by_v: by velocities, shape (n, n).
        M: by accelerations, shape (n, n).
        dt: control period, s.

    Returns:
        Shape (n, n), N m s^2/rad.
    """
    rest = np.maximum(periods - 1.0, 1.0)
    left = 1.0 - np.minimum(max(clock - 1.0, 0.0), rest) / rest
    q_a = 0.5 * dt * dt * (1.0 + rest * (1.0 - left * left))
    a_a = np.where(left > 0.0, -1.0 / rest, 0.0)
    change: Array = by_q * q_a + by_v * (dt * left) + M * a_a
    return change
