# SPDX-License-Identifier: Apache-2.0
"""Lets only steps pass after which a braking plan within every limit is known.

The acceleration limits of the bounds are each joint's own: that all motors together can give them,
with gravity and the coupling of the joints, is a promise of the parameter file, and where a
motor is weak it cannot be made. Here it is not needed. One plan is always in hand that brings the
arm to rest and holds it there, with positions and torques within their limits all the way
(`braking_plan`). A step is taken as it is wanted if such a plan is known from where it leads;
otherwise it is taken between what is wanted and the plan, as near to what is wanted as a few
trials find; in the worst case it is the plan's own, after which the rest of the plan is still in
hand. `docs/theory/whole_arm.md` has the proof and its assumptions. Rates of torques are not
planned.
"""

from __future__ import annotations

from collections import Counter
from math import inf, log
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from torque_safety_controller.parts.whole_arm.braking_plan import (
    AT_REST,
    FIRST,
    RESERVE,
    BrakingPlans,
    PlanLimits,
    PlanTorques,
    braking_periods,
    narrow,
)
from torque_safety_controller.parts.whole_arm.plan_rows import PlanRows
from torque_safety_controller.qp import AccelerationRange, LinearConstraints
from torque_safety_controller.robot_model import RobotModel
from torque_safety_controller.step import Part, Step, joints_beyond
from torque_safety_controller.tasks.task import RestTask
from viability_bounds_pkg.state import State

Array = NDArray[np.float64]

LOST = 0.07
"""Share of a torque limit by which a plan may pass it, after a disturbance, and still be followed
as far as the motors can; beyond, the bounds alone count."""

USUAL_TIME = 0.3
"""Time of plans without a reason for another, s."""

FIRST_TIMES = (USUAL_TIME, 0.15, 0.6, 1.2)
"""Times of the first plan: the first that is safe, or the best."""

LONGEST_TIME = 1.5
"""Longest time of a plan, s."""

FACTORS = (1.15, 1.0 / 1.15, 1.6, 1.0 / 1.6, 4.0, 0.25)
"""By which times of plans are tried, one a step."""

TIME_WEIGHT = 1e-4
"""Weight of the squared logarithm of T over `USUAL_TIME` in the choice of T."""

RELUCTANCE = 0.02
"""Share by which another time must need less, so that it does not change to and fro."""

HALVINGS = 3
"""How often the way between what is wanted and the plan is halved."""

CLEARANCE = 3.0
"""Distance of a plan's end from a position limit, in accelerations times period squared: farther
than the margins of the bounds, which would change a plan that ends nearer."""

TOLERANCE = 0.8
"""Share of that distance by which plans in hand may end nearer, as states drift a little."""

DRIFT = 0.2
"""Share of the tolerance beyond which a plan in hand is repaired."""


class SafetyFilter(Part):
    """Keeps a braking plan of one arm in hand, and changes steps that would lose it.

    The torques of accelerations that are wanted must be within the torque limits, as those of the
    plan are.

    Args:
        model: the arm, n joints with one coordinate each.
        position_min: lower position limits, shape (n,), rad; -inf for none.
        position_max: upper position limits, shape (n,), rad; inf for none.
        acceleration_min: lower acceleration limits of the bounds, shape (n,), rad/s^2. Plans brake
            with no more where no position limit asks for it; it need not always be available.
        acceleration_max: upper ones, shape (n,), rad/s^2.
        tau_max: torque limits, shape (n,), N m.
        dt: control period, s.
        torque_reserve: torque that plans leave for what the model does not know, shape (n,), N m;
            less than what `RESERVE` leaves; None for none.
        velocity_offset: of speed limits that depend on position, as `JointLimits` has them, shape
            (n,), rad/s; None for none.
        deceleration_limit: of the same, shape (n,), rad/s^2.

    Attributes:
        plan: acceleration with which the plan in hand goes on, shape (n,), rad/s^2.
        lower: bounds of what may be wanted, shape (n,), rad/s^2: those given, narrowed to that
            from which each joint by itself has a plan.
        upper: shape (n,), rad/s^2.
        usable: torque that plans may use, shape (n,), N m.
        slack: least share that this plan leaves of it; negative where it needs more.
        lost: whether no plan is near, so that the arm is to brake as it can.
        rest_torque: what holds the arm where this plan ends, shape (n,), N m.
        outcomes: how many steps were "as wanted", "changed", "planned", the plan's own; and
            "outside", without a plan within the limits.
    """

    def __init__(
        self,
        model: pin.Model,
        position_min: Array,
        position_max: Array,
        acceleration_min: Array,
        acceleration_max: Array,
        tau_max: Array,
        dt: float,
        torque_reserve: Array | None = None,
        velocity_offset: Array | None = None,
        deceleration_limit: Array | None = None,
    ) -> None:
        n = model.nv
        c = np.zeros(n) if velocity_offset is None else velocity_offset
        d = np.full(n, np.inf) if deceleration_limit is None else deceleration_limit
        reserve = np.zeros(n) if torque_reserve is None else torque_reserve
        self._tau_max = tau_max
        self.usable: Array = (1.0 - RESERVE) * tau_max - reserve
        self._reserve, self._of_limit = reserve, self.usable / tau_max
        braking = np.minimum(-acceleration_min, acceleration_max)
        clear = CLEARANCE * dt * dt * braking
        self._limits = PlanLimits(
            position_min + clear, position_max - clear, TOLERANCE * clear, braking, dt, c, d
        )
        self._plans = PlanTorques(model, self._limits, self.usable)
        self._rows = PlanRows(model, self.usable, dt)
        self._model, self._dt = model, dt
        self._turn = 0
        self._time = USUAL_TIME  # T of the plan in hand
        self._periods: Array | None = None  # of the plan in hand; None without one
        self._rest: Array = np.ones(n)  # what is left of it after this step
        self._state, self._extra = State(np.zeros(n), np.zeros(n)), np.zeros(n)
        # What the plan in hand needs beyond its limits, after a disturbance.
        self._least_slack = self._most_beyond = 0.0
        self.plan: Array = np.zeros(n)
        self.lower: Array = np.zeros(n)
        self.upper: Array = np.zeros(n)
        self.rest_torque: Array = np.zeros(n)
        self.slack = 0.0
        self.lost = False
        self.outcomes: Counter[str] = Counter()

    def reset(self, robot: RobotModel) -> None:
        """Forget the plan in hand, and count steps from here on."""
        self.forget_plan()
        self._turn = 0
        self.outcomes.clear()

    def remodel(self, robot: RobotModel) -> None:
        """See `Part.remodel`; the plan in hand is looked at again in the next step."""
        self._plans.remodel(robot.model)

    def forget_plan(self) -> None:
        """Begin with a new plan in the next step."""
        self._time, self._periods = USUAL_TIME, None

    def prepare(self, step: Step) -> None:
        """Narrow the bounds, and add rows by which the plan keeps the torque limits."""
        robot = step.robot
        extra = step.torque - robot.M @ step.disturbance
        rows = self.update(robot.q, robot.v, extra, *step.bounds)
        step.bounds = AccelerationRange(self.lower, self.upper)
        if rows is not None:
            step.rows[self] = rows
        step.planned = not self.lost
        if self.lost:
            step.tasks, step.tracking = [RestTask(step.rest)], False
        else:
            step.fallback = self.plan

    def choose(self, step: Step, a: Array) -> Array:
        """Return `a`, or what of it leaves a plan."""
        return self.passed(a + step.disturbance) - step.disturbance

    def report(self) -> dict[str, Any]:
        """See `Part.report`."""
        return {
            "steps_by_plan": self.outcomes,
            "plan_torque_left": self.slack,
            "joints_too_weak_to_hold": self._too_weak() or "none",
        }

    @property
    def trouble(self) -> str:
        """Which joints cannot hold the arm where it would come to rest."""
        weak = self._too_weak()
        return weak and f"the arm cannot be held where it would come to rest: {weak}"

    def _too_weak(self) -> str:
        return joints_beyond(self._model, self.rest_torque, self._tau_max)

    def update(
        self, q: Array, v: Array, extra: Array, lower: Array, upper: Array
    ) -> LinearConstraints | None:
        """Bring the plan to the present state; return the constraints on the step's accelerations.

        They are those of `PlanRows`; None where no plan is near, too.

        Args:
            q: positions, shape (n,), rad.
            v: velocities, shape (n,), rad/s.
            extra: torque that the motors give besides that of the model, shape (n,), N m; plans
                count what of it is more than the reserve.
            lower: bounds of the joints' accelerations, which keep their own limits, rad/s^2.
            upper: shape (n,), rad/s^2.
        """
        # Up to the reserve it may change at any time, so that the plans must not count on it.
        self._extra = extra - np.minimum(np.maximum(extra, -self._reserve), self._reserve)
        self._state = State(q, v)
        if self._periods is None:
            plans, chosen = self._first_plan()
        else:
            plans, chosen = self._repaired(self._periods)
        self._periods = plans.periods[chosen]
        self._rest = np.maximum(self._periods - 1.0, 1.0)
        self.slack = float(plans.slack[chosen])
        self._least_slack = min(self.slack, 0.0)
        self._most_beyond = float(plans.beyond[chosen])
        self.plan = plans.samples.a[chosen, FIRST]
        self.rest_torque = plans.tau[chosen, AT_REST]
        self.lower, self.upper = narrow(q, v, self.plan, lower, upper, self._limits)
        most = float((plans.peaks[chosen] * self._of_limit).max())
        self.lost = not most <= 1.0 + LOST
        return self._rows.of(plans, chosen) if most <= 1.0 else None

    def passed(self, a: Array) -> Array:
        """Return `a`, or what is nearest to it of the trials on the way to the plan in hand.

        Args:
            a: acceleration wanted, disturbances included, shape (n,), rad/s^2.
        """
        self._turn = (self._turn + 1) % len(FACTORS)
        other = self._time * FACTORS[self._turn]
        if self._keep_plan_after(a, other):
            self.outcomes["as wanted"] += 1
            return a
        if self.lost and np.isfinite(a).all():
            self.outcomes["outside"] += 1
            self.forget_plan()
            return a
        plan, low, high = self.plan, 0.0, 1.0
        for _ in range(HALVINGS):
            share = 0.5 * (low + high)
            if self._safe(self._plans_after(plan + share * (a - plan), self._rest[np.newaxis]))[0]:
                low = share
            else:
                high = share
        self.outcomes["changed" if low > 0.0 else "planned"] += 1
        chosen = plan + low * (a - plan) if low > 0.0 else plan
        # The rest of the plan is safe. At rest it would end in plans too short to start from.
        time = max(self._time - self._dt, self._dt)
        if not self._keep_plan_after(chosen, max(time, other)):
            self._time, self._periods = time, self._rest
        return chosen

    def _first_plan(self) -> tuple[BrakingPlans, int]:
        """Return the plans of `FIRST_TIMES`, and the first that is safe, or else the best."""
        q, v = self._state
        periods = braking_periods(q, v, np.array(FIRST_TIMES), self._limits)
        plans = self._plans.evaluate(q, v, periods, self._extra)
        safe = plans.slack >= 0.0
        chosen = int(np.argmax(safe if safe.any() else plans.slack))
        self._time = FIRST_TIMES[chosen]
        return plans, chosen

    def _repaired(self, periods: Array) -> tuple[BrakingPlans, int]:
        """Return the plan in hand; where joints have drifted to a limit, also one that stops them.

        It is chosen if it is not worse otherwise.
        """
        (q, v), limits = self._state, self._limits
        end = q + 0.5 * limits.dt * v * periods
        low, high = np.minimum(q, end), np.maximum(q, end)
        fine = np.maximum(high - limits.q_max, limits.q_min - low) <= DRIFT * limits.tolerance
        rows = periods[np.newaxis]
        if not fine.all():
            fresh = braking_periods(q, v, np.array([self._time]), limits)
            rows = np.concatenate([rows, np.where(fine, periods, fresh)])
        plans = self._plans.evaluate(q, v, rows, self._extra)
        better = len(rows) > 1 and (
            plans.slack[1] >= min(plans.slack[0], 0.0) and plans.beyond[1] <= plans.beyond[0]
        )
        return plans, int(better)

    def _keep_plan_after(self, a: Array, other: float) -> bool:
        """Keep the safe plan after a step of `a` that needs least; return whether there is one.

        Three are tried: the time of the plan in hand, the time `other`, s, and the rest of it.
        """
        now, dt = self._time, self._dt
        times = [now, other] if dt <= other <= LONGEST_TIME else [now]
        q, v = self._state.after(a, dt)
        fresh = braking_periods(q, v, np.array(times), self._limits)
        times.append(max(now - dt, dt))
        plans = self._plans_after(a, np.concatenate([fresh, self._rest[np.newaxis]]))
        peaks = plans.peaks * plans.peaks
        needed = (peaks * peaks).sum(axis=1).tolist()
        best, usual = inf, [log(T / USUAL_TIME) ** 2 for T in times]
        for i in np.flatnonzero(self._safe(plans)).tolist():
            cost = needed[i] + TIME_WEIGHT * usual[i]
            if i > 0 and usual[i] >= usual[0]:
                cost *= 1.0 + RELUCTANCE  # not back to usual: at rest nothing else leads there
            if cost < best:
                best, self._time, self._periods = cost, times[i], plans.periods[i]
        return best < inf

    def _plans_after(self, a: Array, periods: Array) -> BrakingPlans:
        """Return plans from the state after a step of `a`."""
        return self._plans.evaluate(*self._state.after(a, self._dt), periods, self._extra)

    def _safe(self, plans: BrakingPlans) -> NDArray[np.bool_]:
        """Return which plans are within the limits; not worse than the one in hand is enough."""
        return (plans.slack >= self._least_slack) & (plans.beyond <= self._most_beyond)
