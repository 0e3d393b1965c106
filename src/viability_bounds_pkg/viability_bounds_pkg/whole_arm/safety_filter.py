# SPDX-License-Identifier: Apache-2.0
"""Lets only steps pass after which a braking plan within every limit is known.

The acceleration limits of the bounds are each joint's own: that all motors together can give them,
with gravity and the coupling of the joints, is a promise of the parameter file, and where a
motor is weak it cannot be made. Here it is not needed. One plan is always in hand that brings the
arm to rest and holds it there, with positions, speeds and torques within their limits all the
way (`braking_plan`). A step is taken as it is wanted if such a plan is known from where it leads;
otherwise it is taken between what is wanted and the plan, as near to what is wanted as a few
trials find; in the worst case it is the plan's own, after which the rest of the plan is still in
hand. `docs/whole_arm.md` has the proof and its assumptions.
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

LOST = 0.1
"""Share of a torque limit by which a plan may pass it, after a disturbance, and still be followed
as far as the motors can; beyond, the bounds alone count."""

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

RELUCTANCE = 0.02
"""Share by which another time must need less, so that it does not change to and fro."""

HALVINGS = 3
"""How often the way between what is wanted and the plan is halved."""

CLEARANCE = 3.0
"""Distance of a plan's end from a position limit, in accelerations times period squared: farther
than the margins of the bounds, which would change a plan that ends nearer."""


class Rows(NamedTuple):
    """Linear constraints ``G a <= upper`` on the accelerations of a step, |G_i| = 1."""

    G: Array
    """Shape (k, n)."""
    upper: Array
    """Shape (k,), rad/s^2."""


class SafetyFilter:
    """Keeps a braking plan of one arm in hand, and changes steps that would lose it.

    Call `look` at the beginning of each control step, then `choose` with the accelerations that
    are wanted: those that the arm is to have, disturbances included.

    Args:
        model: the arm, n joints with one coordinate each.
        position_min: lower position limits, shape (n,), rad; -inf for none.
        position_max: upper position limits, shape (n,), rad; inf for none.
        acceleration_min: lower acceleration limits of the bounds, shape (n,), rad/s^2. Plans brake
            with no more where no position limit asks for it; it need not always be available.
        acceleration_max: upper ones, shape (n,), rad/s^2.
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
        JointLimitsError: not one value for each joint, or one that is not finite or of the wrong
            sign.
    """

    def __init__(
        self,
        model: pin.Model,
        position_min: ArrayLike,
        position_max: ArrayLike,
        acceleration_min: ArrayLike,
        acceleration_max: ArrayLike,
        tau_max: ArrayLike,
        dt: float,
    ) -> None:
        n, names = model.nv, tuple(model.names)[1:]
        q_min, q_max, a_min, a_max, torques = (
            joint_array(field, values, names)
            for field, values in (
                ("position_min", position_min),
                ("position_max", position_max),
                ("acceleration_min", acceleration_min),
                ("acceleration_max", acceleration_max),
                ("tau_max", tau_max),
            )
        )
        for field, values, sign in (
            ("acceleration_min", a_min, -1.0),
            ("acceleration_max", a_max, 1.0),
            ("tau_max", torques, 1.0),
        ):
            for name, value in zip(names, values.tolist(), strict=True):
                if not (np.isfinite(value) and sign * value > 0.0):
                    allowed = f"must be finite and {'positive' if sign > 0.0 else 'negative'}"
                    raise JointLimitsError(field, name, value, allowed)
        rates = np.minimum(-a_min, a_max)
        self._a_min, self._a_max = a_min, a_max
        self._usable = (1.0 - RESERVE) * torques
        clearance = CLEARANCE * dt * dt * rates
        self._plans = PlanTorques(
            model, q_min + clearance, q_max - clearance, rates, self._usable, dt, clearance
        )
        self._dt = dt
        self._model, self._data = model, model.createData()
        self._time = USUAL  # T of the plan in hand
        self._times: Array = np.full(n, dt)  # when each joint stands in it, from now on
        self._begun = False
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
        self._time, self._begun = USUAL, False

    def can_hold(self, q: Array) -> bool:
        """Return whether plans may end in a posture: whether it leaves what plans leave.

        Args:
            q: positions, shape (n,), rad.
        """
        needed = np.abs(pin.computeGeneralizedGravity(self._model, self._data, q))
        return bool((needed <= (1.0 - KEPT) * self._usable).all())

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

        To first order, and approaching limits with `APPROACH`; None where all are far, or no
        plan is near. The plan's acceleration keeps to it.

        Args:
            q: positions, shape (n,), rad.
            v: velocities, shape (n,), rad/s.
            extra: torque that the motors give besides that of the model, shape (n,), N m.
            lower: bounds of the joints' accelerations, which keep their own limits, rad/s^2.
            upper: shape (n,), rad/s^2.
        """
        self._q, self._v, self._extra = q, v, extra
        plans = self._plans
        if self._begun:
            self.slack = plans.follow(q, v, self._times, extra)
        else:
            self.slack = plans.plan(q, v, self._time, extra)
            self._times, self._begun = plans.times.copy(), True
        self._beyond = plans.beyond
        # The bounds have margins for errors within a step, which the plan has not. Acceleration
        # limits are none to the plan: its torques are known.
        low = np.where(lower <= self._a_min, -np.inf, lower)
        high = np.where(upper >= self._a_max, np.inf, upper)
        self.plan = np.minimum(np.maximum(-v / plans.times, low), high)
        rest = len(plans.clock) - 1
        self.rest_torque = plans.tau[rest].copy()
        if self.slack < -RESERVE:
            return None  # nothing to keep: the bounds alone count
        wanted: dict[int, list[int]] = {}
        # With fewer samples the largest torque would move to and fro between them.
        for j in np.flatnonzero(plans.loads > NEAR).tolist():
            for k in {0, int(plans.busiest[j]), rest}:
                if abs(plans.tau[k, j]) > NEAR * self._usable[j]:
                    wanted.setdefault(k, []).append(j)
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
            sensitivity(self._dt, plans.times, plans.clock[k], by_q, by_v, M, gradient)
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
        other = self._time * FACTORS[self._turn]
        rest = np.maximum(self._times - self._dt, self._dt)
        if self._take(a, rest, other):
            self.outcomes["as wanted"] += 1
            return a
        if self.slack < -LOST and np.isfinite(a).all():
            self.outcomes["outside"] += 1
            self._begun = False
            return a
        low, high = 0.0, 1.0
        for _ in range(HALVINGS):
            share = 0.5 * (low + high)
            if self._safe(self.plan + share * (a - self.plan), rest):
                low = share
            else:
                high = share
        self.outcomes["changed" if low > 0.0 else "planned"] += 1
        chosen = self.plan + low * (a - self.plan) if low > 0.0 else self.plan
        # The rest of the plan is safe. At rest it would end in plans too short to begin from.
        time = max(self._time - self._dt, self._dt)
        if not self._take(chosen, rest, max(time, other)):
            self._time, self._times = time, rest
        return chosen

    def _take(self, a: Array, rest: Array, other: float) -> bool:
        """Take the plan after `a` that needs least, of those that are safe; False without one.

        Args:
            a: acceleration of the step, shape (n,), rad/s^2.
            rest: what is left of the times of the plan in hand, shape (n,), s.
            other: time of a plan to try besides that of the plan in hand, s.
        """
        best, time, times = np.inf, self._time, None
        for T, given in (
            (self._time, None),
            (other, None),
            (max(self._time - self._dt, self._dt), rest),
        ):
            if self._dt <= T <= LONGEST and self._safe(a, T if given is None else given):
                cost = self._plans.cost + PULL * np.log(T / USUAL) ** 2
                if self._time != T:
                    cost *= 1.0 + RELUCTANCE
                if cost < best:
                    best, time, times = cost, T, self._plans.times.copy()
        if times is None:
            return False
        self._time, self._times = time, times
        return True

    def _safe(self, a: Array, plan: float | Array) -> bool:
        """Return whether a plan after a step is within the limits.

        Where the plan in hand is not, because of a disturbance, it must not be worse.

        Args:
            a: acceleration of the step, shape (n,), rad/s^2.
            plan: its time T, or when each joint stands, shape (n,), s.
        """
        dt, v, plans = self._dt, self._v, self._plans
        after = self._q + dt * v + 0.5 * dt * dt * a, v + dt * a
        if isinstance(plan, float):
            slack = plans.plan(*after, plan, self._extra)
        else:
            slack = plans.follow(*after, plan, self._extra)
        return slack >= min(0.0, self.slack) and plans.beyond <= self._beyond
