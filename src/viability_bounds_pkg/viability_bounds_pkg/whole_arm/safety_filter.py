# SPDX-License-Identifier: Apache-2.0
"""Lets only steps pass after which a braking plan within every limit is known.

The acceleration limits of the bounds are each joint's own: that all motors together can give them,
with gravity and the coupling of the joints, is a promise of the parameter file, and where a
motor is weak it cannot be made. Here it is not needed. One plan is always in hand that brings the
arm to rest and holds it there, with positions, speeds and torques within their limits all the
way (`braking_plan`). A step is taken as it is wanted if such a plan is known from where it leads;
otherwise it is taken on the way between what is wanted and the plan, as near to what is wanted as
a few trials find; in the worst case it is the plan's own, after which the rest of the plan is still
in hand. `docs/whole_arm.md` has the proof and its assumptions.
"""

from __future__ import annotations

from collections import Counter
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

from viability_bounds_pkg.joint_limits import JointLimitsError, joint_array
from viability_bounds_pkg.whole_arm.braking_plan import sensitivity
from viability_bounds_pkg.whole_arm.plan_torques import PlanTorques

Array = NDArray[np.float64]

RESERVE = 0.03
"""Share of the torque limits that plans leave: for what lies between their samples, for steps of
constant acceleration under held torque, and for errors of the model."""

KEPT = 0.01
"""Further share that the constraints on a step leave, so that its trial seldom fails."""

NEAR = 0.6
"""Share of a torque limit above which a plan's torque constrains the step."""

APPROACH = 0.04
"""Time constant with which a step may use up what a plan leaves of a torque limit, s."""

USUAL = 0.3
"""Time of plans without a reason for another, s."""

LONGEST = 1.5
"""Longest time of a plan, s."""

FACTORS = (1.15, 1.0 / 1.15, 1.6, 1.0 / 1.6, 4.0, 0.25)
"""By which times of plans are tried, one a step."""

PULL = 1e-4
"""Weight of the squared logarithm of T over `USUAL` in the choice of T."""

HALVINGS = 3
"""How often the way between what is wanted and the plan is halved."""

CLEARANCE = 0.3
"""Distance of a plan's end from a position limit, in accelerations times period squared: a joint
that brakes a little less than planned in the last steps does not pass the limit."""


class Rows(NamedTuple):
    """Linear constraints ``G a <= upper`` on the accelerations of a step, |G_i| = 1."""

    G: Array
    """Shape (k, n)."""
    upper: Array
    """Shape (k,), rad/s^2."""


class SafetyFilter:
    """Keeps a braking plan of one arm in hand, and changes steps that would lose it.

    Call `look` at the beginning of each control step, then `choose` with the accelerations that
    are wanted. Accelerations are those that the arm is to have: what disturbances add is in `extra`.

    Args:
        model: the arm, n joints with one coordinate each.
        position_min: lower position limits, shape (n,), rad; -inf for none.
        position_max: upper position limits, shape (n,), rad; inf for none.
        braking: acceleration with which plans brake where no position limit asks for more, shape
            (n,), rad/s^2; it need not be available in every state.
        tau_max: torque limits, shape (n,), N m.
        dt: control period, s.

    Attributes:
        plan: acceleration with which the plan in hand goes on, shape (n,), rad/s^2.
        slack: least share of a torque limit that this plan leaves of what it may use; negative
            where it passes a limit.
        rest_torque: what holds the arm where this plan ends, shape (n,), N m.
        outcomes: how many steps were "as wanted", "changed", "planned", the plan's own; and
            "outside", without a plan within the limits.

    Raises:
        JointLimitsError: not one value for each joint, or braking or torques that are not finite
            and positive.
    """

    def __init__(
        self,
        model: pin.Model,
        position_min: ArrayLike,
        position_max: ArrayLike,
        braking: ArrayLike,
        tau_max: ArrayLike,
        dt: float,
    ) -> None:
        n, names = model.nv, tuple(model.names)[1:]
        q_min, q_max, rates, torques = (
            joint_array(field, values, names)
            for field, values in (
                ("position_min", position_min),
                ("position_max", position_max),
                ("braking", braking),
                ("tau_max", tau_max),
            )
        )
        for field, values in (("braking", rates), ("tau_max", torques)):
            for name, value in zip(names, values.tolist(), strict=True):
                if not (np.isfinite(value) and value > 0.0):
                    raise JointLimitsError(field, name, value, "must be finite and positive")
        self._usable = (1.0 - RESERVE) * torques
        clearance = CLEARANCE * dt * dt * rates
        self._plans = PlanTorques(
            model, q_min + clearance, q_max - clearance, rates, self._usable, dt, clearance
        )
        self._dt = dt
        self._model, self._data = model, model.createData()
        self._time = USUAL
        self._turn = 0
        self._q = self._v = self._extra = np.zeros(n)
        self._gradient = np.zeros((n, n))
        self._beyond = 0.0
        self.plan: Array = np.zeros(n)
        self.rest_torque: Array = np.zeros(n)
        self.slack = 0.0
        self.outcomes: Counter[str] = Counter()
        self._warm_up()

    def reset(self) -> None:
        """Forget the plan in hand."""
        self._time = USUAL

    def _warm_up(self) -> None:
        """Compile everything now and not in a control loop."""
        zero = np.zeros_like(self._usable)
        self.look(zero, zero, zero, zero - 1.0, zero + 1.0)
        self._rows({0: [0]})
        self.choose(zero)
        self.reset()
        self.outcomes.clear()

    def look(self, q: Array, v: Array, extra: Array, lower: Array, upper: Array) -> Rows | None:
        """Look at the state in which a step begins; return what its accelerations must keep to.

        To first order, and approaching limits with `APPROACH`; None where all are far. The plan's
        acceleration keeps to it.

        Args:
            q: positions, shape (n,), rad.
            v: velocities, shape (n,), rad/s.
            extra: torque that the motors give besides that of the model, shape (n,), N m.
            lower: bounds of the joints' accelerations, which keep their own limits, rad/s^2.
            upper: shape (n,), rad/s^2.
        """
        self._q, self._v, self._extra = q, v, extra
        plans = self._plans
        self.slack = plans.look(q, v, self._time, extra)
        self._beyond = plans.beyond
        # The bounds have margins for errors within a step, which the plan has not.
        self.plan = np.minimum(np.maximum(-v / plans.times, lower), upper)
        rest = len(plans.clock) - 1
        self.rest_torque = plans.tau[rest].copy()
        at_rest = np.abs(self.rest_torque) > NEAR * self._usable
        wanted: dict[int, list[int]] = {}
        for j in np.flatnonzero(plans.loads > NEAR).tolist():
            wanted.setdefault(int(plans.busiest[j]), []).append(j)
            if at_rest[j] and plans.busiest[j] != rest:
                wanted.setdefault(rest, []).append(j)
        return self._rows(wanted) if wanted else None

    def _rows(self, wanted: dict[int, list[int]]) -> Rows:
        """Return the rows of joints at samples."""
        plans, gradient = self._plans, self._gradient
        use = min(self._dt / APPROACH, 1.0)
        rows, upper = [], []
        for k, joints in wanted.items():
            by_q, by_v, M = pin.computeRNEADerivatives(
                self._model,
                self._data,
                plans.positions[k],
                plans.velocities[k],
                plans.accelerations[k],
            )
            sensitivity(self._dt, plans.times, plans.kind, plans.clock[k], by_q, by_v, M, gradient)
            for j in joints:
                tau = plans.tau[k, j]
                row = gradient[j] if tau > 0.0 else -gradient[j]
                left = (1.0 - KEPT) * self._usable[j] - abs(tau)
                size = max(float(np.sqrt(row @ row)), 1e-9)
                rows.append(row / size)
                upper.append((use * left + float(row @ self.plan)) / size)
        return Rows(np.array(rows), np.array(upper))

    def choose(self, a: Array) -> Array:
        """Return `a`, or what is nearest to it of the trials on the way to the plan in hand.

        Args:
            a: acceleration wanted, shape (n,), rad/s^2.
        """
        self._turn = (self._turn + 1) % len(FACTORS)
        left = max(self._time - self._dt, self._dt)
        other = self._time * FACTORS[self._turn]
        if self._take(a, self._time, other, left):
            self.outcomes["as wanted"] += 1
            return a
        if self.slack < -RESERVE and np.isfinite(a).all():  # the motors cannot give the plan's
            self.outcomes["outside"] += 1
            return a
        low, high = 0.0, 1.0
        for _ in range(HALVINGS):
            share = 0.5 * (low + high)
            if self._safe(self.plan + share * (a - self.plan), left):
                low = share
            else:
                high = share
        self.outcomes["changed" if low > 0.0 else "planned"] += 1
        chosen = self.plan + low * (a - self.plan) if low > 0.0 else self.plan
        # What is left of the plan is safe; at rest it would end in plans too short to begin from.
        if not self._take(chosen, left, max(left, other)):
            self._time = left
        return chosen

    def _take(self, a: Array, *times: float) -> bool:
        """Take the plan after `a` that needs least, of those that are safe; False without one."""
        best = np.inf
        for T in times:
            if self._dt <= T <= LONGEST and self._safe(a, T):
                cost = self._plans.cost + PULL * np.log(T / USUAL) ** 2
                if cost < best:
                    best, self._time = cost, T
        return best < np.inf

    def _safe(self, a: Array, T: float) -> bool:
        """Return whether the plan of time `T` after a step is within the limits.

        Where the plan in hand is not, because of a disturbance, it must not be worse.
        """
        dt, v = self._dt, self._v
        slack = self._plans.look(self._q + dt * v + 0.5 * dt * dt * a, v + dt * a, T, self._extra)
        return slack >= min(0.0, self.slack) and self._plans.beyond <= self._beyond
