# SPDX-License-Identifier: Apache-2.0
"""Lets only steps pass after which a braking plan within every limit is known.

The acceleration limits of the bounds are each joint's own: that all motors together can give them,
with gravity and the coupling of the joints, is a promise of the parameter file, and where a
motor is weak it cannot be made. Here it is not needed. One plan is always in hand that brings the
arm to rest and holds it there, with positions, speeds and torques within their limits all the
way (`braking_plan`), and the limits of their changes from step to step where
there are such. A step is taken as it is wanted if such a plan is known from where it leads;
otherwise it is taken between what is wanted and the plan, as near to what is wanted as a few
trials find; in the worst case it is the plan's own, after which the rest of the plan is still in
hand. `docs/whole_arm.md` has the proof and its assumptions.
"""

from __future__ import annotations

from collections import Counter
from math import log
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

from viability_bounds_pkg.joint_limits import JointLimitsError, joint_array
from viability_bounds_pkg.state import State
from viability_bounds_pkg.whole_arm.braking_plan import (
    Course,
    JointLimitsOfPlans,
    copy_course,
    new_course,
    repair,
    rest_of,
    viable_range,
)
from viability_bounds_pkg.whole_arm.plan_samples import (
    FIRST,
    sensitivity,
)
from viability_bounds_pkg.whole_arm.plan_torques import RATE_RESERVE, PlanTorques

Array = NDArray[np.float64]

RESERVE = 0.03
"""Share of the torque limits that plans leave: for what lies between their samples, for steps of
constant acceleration under held torque, and for small errors of the model."""

KEPT = 0.01
"""Further share that the constraints on a step leave, so that its trial seldom fails."""

TO_BEGIN = 0.002
"""What the torque of the step itself may take of that: else an arm that stands where it leaves no
more could not even begin to move away from there."""

LOST = 0.07
"""Share of a torque limit by which a plan may pass it, after a disturbance, and still be followed
as far as the motors can; beyond, the bounds alone count."""

NEAR = 0.6
"""Share of a torque limit above which a plan's torque constrains the step."""

APPROACH = 0.04
"""Time constant with which a step may use up what a plan leaves of a torque limit, s."""

RETURN = 0.12
"""Time constant with which a step leads back to what a plan is to leave, s: gently, because noise
of the states moves plans as well."""

USUAL = 0.3
"""Time of plans without a reason for another, s."""

UNHURRIED = 1.0
"""Time of plans that brake gently, s."""

BEGINNINGS = (USUAL, 0.15, 0.6, 1.2)
"""Times of plans to begin with: the first that is safe, or the best."""

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

GENTLE = 0.5
"""Share of the limits of the torques' rates that the joints' accelerations use in plans."""

DRIFT = 0.1
"""Further distance where changes are limited, in speeds times period: plans are longer carried on
then, and the bounds do not lead back from the limit at once."""

TOLERANCE = 0.8
"""Share of that distance by which plans in hand may end nearer, as states drift a little."""

SPARE = 0.005
"""Share of the limits of speeds and of the accelerations' rates that plans leave where changes are
limited, because states drift a little while a plan is carried on; what is asked for leaves twice
as much."""


class Rows(NamedTuple):
    """Linear constraints ``G a <= upper`` on the accelerations of a step, |G_i| = 1."""

    G: Array
    """Shape (k, n)."""
    upper: Array
    """Shape (k,), rad/s^2."""


class Needs(NamedTuple):
    """What a plan needs at worst: see `PlanTorques`."""

    slack: float
    """At most 0."""
    beyond: float
    """rad."""
    excess: float
    """Share."""
    hurry: float
    """Share."""

    @classmethod
    def of(cls, plan: PlanTorques) -> Needs:
        """Return what the plan that was looked at last needs."""
        # Samples move while a plan is carried on; what is between them has the reserve.
        hurry = min(plan.hurry, 0.5 * RATE_RESERVE)
        return cls(min(plan.slack, 0.0), plan.beyond, plan.excess, hurry)

    def cover(self, plan: PlanTorques) -> bool:
        """Return whether a plan needs no more."""
        return (
            plan.slack >= self.slack
            and plan.beyond <= self.beyond
            and plan.excess <= self.excess
            and plan.hurry <= self.hurry
        )


class SafetyFilter:
    """Keeps a braking plan of one arm in hand, and changes steps that would lose it.

    Call `look` at the beginning of each control step, then `choose` with the accelerations that
    are wanted: those that the arm is to have, disturbances included. Their torques must be within
    the limits of torques and their rates, as those of the plan are.

    Args:
        model: the arm, n joints with one coordinate each.
        position_min: lower position limits, shape (n,), rad; -inf for none.
        position_max: upper position limits, shape (n,), rad; inf for none.
        acceleration_min: lower acceleration limits of the bounds, shape (n,), rad/s^2. Plans brake
            with no more where no position limit asks for it; it need not always be available.
        acceleration_max: upper ones, shape (n,), rad/s^2.
        tau_max: torque limits, shape (n,), N m.
        dt: control period, s.
        velocity_max: speed limits, shape (n,), rad/s; needed where changes are limited.
        jerk_max: limits of the accelerations' rates, shape (n,), rad/s^3; inf or None for none.
        torque_rate_max: limits of the torques' rates, shape (n,), N m/s; inf or None for none.
        torque_reserve: torque that plans leave for what the model does not know, shape (n,), N m;
            None for none.

    Attributes:
        plan: acceleration with which the plan in hand goes on, shape (n,), rad/s^2.
        lower: bounds of what may be wanted, shape (n,), rad/s^2: those given to `look`, narrowed
            to that from which each joint by itself has a plan.
        upper: shape (n,), rad/s^2.
        usable: torque that plans may use, shape (n,), N m.
        slack: least share that this plan leaves of it; negative where it needs more.
        lost: whether no plan is near, so that the arm is to brake as it can.
        usual: time of plans without a reason for another, s. `UNHURRIED` lets an arm move away
            from the edge of what it can hold where little torque is left to brake with.
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
        velocity_max: ArrayLike | None = None,
        jerk_max: ArrayLike | None = None,
        torque_rate_max: ArrayLike | None = None,
        torque_reserve: ArrayLike | None = None,
    ) -> None:
        n, names = model.nv, tuple(model.names)[1:]
        none = np.full(n, np.inf)
        nothing = np.zeros(n)
        q_min, q_max, a_min, a_max, torques, reserve, v_max, jerks, rates = (
            joint_array(field, none if values is None else values, names)
            for field, values in (
                ("position_min", position_min),
                ("position_max", position_max),
                ("acceleration_min", acceleration_min),
                ("acceleration_max", acceleration_max),
                ("tau_max", tau_max),
                ("torque_reserve", nothing if torque_reserve is None else torque_reserve),
                ("velocity_max", velocity_max),
                ("jerk_max", jerk_max),
                ("torque_rate_max", torque_rate_max),
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
        for field, values in (
            ("velocity_max", v_max),
            ("jerk_max", jerks),
            ("torque_rate_max", rates),
        ):
            for name, value in zip(names, values.tolist(), strict=True):
                if not value > 0.0:
                    raise JointLimitsError(field, name, value, "must be positive")
        self.usable: Array = (1.0 - RESERVE) * torques - reserve
        for name, value, left in zip(names, reserve.tolist(), self.usable.tolist(), strict=True):
            if not (value >= 0.0 and left > 0.0):
                allowed = f"must be >= 0 and less than {1.0 - RESERVE:g} of the torque limit"
                raise JointLimitsError("torque_reserve", name, value, allowed)
        braking = np.minimum(-a_min, a_max)
        self._reserve, self._of_limit = reserve, self.usable / torques
        self._smooth = bool(np.isfinite(jerks).any() or np.isfinite(rates).any())
        clearance = CLEARANCE * dt * dt * braking
        if self._smooth:
            clearance = clearance + DRIFT * dt * np.where(np.isfinite(v_max), v_max, 0.0)
        else:
            v_max = none  # speeds only fall along plans
        self._limits = JointLimitsOfPlans(
            q_min + clearance,
            q_max - clearance,
            TOLERANCE * clearance,
            (1.0 - SPARE) * v_max,
            braking,
            dt * jerks,
        )
        self._narrower = self._limits._replace(v_max=(1.0 - 2.0 * SPARE) * v_max)
        allowed_change = (1.0 - RATE_RESERVE) * dt * rates
        self._plans = PlanTorques(model, self._limits, self.usable, allowed_change, dt)
        self._dt = dt
        self._model, self._data = model, model.createData()
        self.usual = USUAL
        self._time = USUAL  # T of the plan in hand
        self._tau_change = dt * rates
        self._gentle: Array = none
        self._course, self._rest = new_course(n), new_course(n)
        self._begun = False
        self._turn = 0
        self._state = State(np.zeros(n), np.zeros(n))
        self._extra = np.zeros(n)
        self._last: Array = np.zeros(n)
        self._gradient = np.zeros((n, n))
        self._now = Needs(0.0, 0.0, 0.0, 0.0)
        self.plan: Array = np.zeros(n)
        self.lower: Array = np.zeros(n)
        self.upper: Array = np.zeros(n)
        self.rest_torque: Array = np.zeros(n)
        self.slack = 0.0
        self.lost = False
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
        return bool((needed <= (1.0 - KEPT) * self.usable).all())

    def _warm_up(self) -> None:
        """Compile everything now and not in a control loop."""
        zero = np.zeros_like(self.usable)
        for _ in range(2):  # a plan is begun, then carried on
            self.look(zero, zero, zero, zero - 1.0, zero + 1.0)
        self._rows({FIRST: [0]})
        self.choose(zero)
        self.reset()
        self.outcomes.clear()

    def look(
        self,
        q: Array,
        v: Array,
        extra: Array,
        lower: Array,
        upper: Array,
        last: Array | None = None,
    ) -> Rows | None:
        """Look at the state in which a step begins; return what its accelerations must keep to.

        To first order, and approaching limits with `APPROACH`; None where all are far, or no
        plan is near. The plan's acceleration keeps to it.

        Args:
            q: positions, shape (n,), rad.
            v: velocities, shape (n,), rad/s.
            extra: torque that the motors give besides that of the model, shape (n,), N m; plans
                count what of it is more than the reserve.
            lower: bounds of the joints' accelerations, which keep their own limits, rad/s^2.
            upper: shape (n,), rad/s^2.
            last: acceleration of the step before, shape (n,), rad/s^2; None after a rest.
        """
        # Up to the reserve it may change at any time, so that the plans must not count on it.
        extra = extra - np.clip(extra, -self._reserve, self._reserve)
        before, self._state, self._extra = self._state, State(q, v), extra
        self._last = np.zeros_like(q) if last is None else last
        plans = self._plans
        if self._smooth:
            self._gentle = self._gentle_changes(q)
        if self._begun:
            self._go_on(before)
        else:
            self._begin()
        rest_of(self._course, self._rest)
        self.slack = plans.slack
        self._now = Needs.of(plans)
        self.plan = plans.accelerations[FIRST].copy()
        self.rest_torque = plans.tau[plans.at_rest].copy()
        self._narrow(lower, upper)
        most = float((plans.loads * self._of_limit).max())
        self.lost = not most <= 1.0 + LOST
        if not most <= 1.0:
            return None  # nothing to keep: the bounds alone count
        wanted: dict[int, list[int]] = {}
        # With fewer samples the largest torque would move to and fro between them.
        for j in np.flatnonzero(plans.loads > NEAR).tolist():
            for k in {FIRST, int(plans.busiest[j]), plans.at_rest}:
                if abs(plans.tau[k, j]) > NEAR * self.usable[j]:
                    wanted.setdefault(k, []).append(j)
        return self._rows(wanted) if wanted else None

    def _go_on(self, before: State) -> None:
        """Look at the plan in hand; where joints have drifted towards a limit, repair it.

        From the torques in `before`, where the step before began, too, a repaired plan must not
        change too fast.
        """
        plans, begin, last, extra = self._plans, self._state, self._last, self._extra
        drifted = repair(
            *begin,
            last,
            self._time,
            self._gentle,
            self._limits,
            self._dt,
            self._course,
            self._rest,
        )
        plans.follow(*begin, last, self._course, extra)
        if not drifted:
            return
        own = Needs.of(plans)
        plans.follow(*begin, last, self._rest, extra, before)
        if plans.beyond <= own.beyond and own._replace(beyond=plans.beyond).cover(plans):
            copy_course(self._rest, self._course)
        else:
            plans.follow(*begin, last, self._course, extra)

    def _begin(self) -> None:
        """Take the best plan of some times, the usual one if it is safe."""
        best = -np.inf
        for T in BEGINNINGS:
            plans = self._plans
            plans.plan(*self._state, self._last, T, self._gentle, self._extra)
            if plans.slack > best:
                best = plans.slack
                self._keep(T)
            if best >= 0.0:
                break
        plans.follow(*self._state, self._last, self._course, self._extra)
        self._begun = True

    def _narrow(self, lower: Array, upper: Array) -> None:
        """Narrow the bounds to what each joint by itself can stop from again."""
        self.lower, self.upper = lower.copy(), upper.copy()
        viable_range(
            *self._state,
            self.plan,
            self._last,
            self._time,
            self._gentle,
            self._narrower,
            self._dt,
            self.lower,
            self.upper,
        )

    def _gentle_changes(self, q: Array) -> Array:
        """Return changes of acceleration that the limits of torques' rates allow, rad/s^2.

        In proportion to how hard the joints brake, and small enough that all joints may change
        at once, whatever their signs. What else changes torques has the rest of the limits.
        """
        M = pin.crba(self._model, self._data, q)
        inertia = np.abs(np.triu(M) + np.triu(M, 1).T)
        braking = self._limits.braking
        share = GENTLE * float((self._tau_change / (inertia @ braking)).min())
        return np.minimum((1.0 - SPARE) * self._limits.change_max, share * braking)

    def _rows(self, wanted: dict[int, list[int]]) -> Rows:
        """Return the rows of joints at samples."""
        plans, gradient = self._plans, self._gradient
        use, back = min(self._dt / APPROACH, 1.0), min(self._dt / RETURN, 1.0)
        rows, upper = [], []
        for k, joints in wanted.items():
            by_q, by_v, M = pin.computeRNEADerivatives(
                self._model,
                self._data,
                plans.positions[k],
                plans.velocities[k],
                plans.accelerations[k],
            )
            sensitivity(self._dt, plans.course, plans.clock[k], by_q, by_v, M, gradient)
            for j in joints:
                tau = plans.tau[k, j]
                row = gradient[j] if tau > 0.0 else -gradient[j]
                kept = KEPT if k != FIRST else KEPT - TO_BEGIN
                left = (1.0 - kept) * self.usable[j] - abs(tau)
                size = max(float(np.sqrt(row @ row)), 1e-9)
                rows.append(row / size)
                part = (use if left > 0.0 else back) * left
                upper.append((part + float(row @ self.plan)) / size)
        return Rows(np.array(rows), np.array(upper))

    def choose(self, a: Array) -> Array:
        """Return `a`, or what is nearest to it of the trials on the way to the plan in hand.

        Args:
            a: acceleration wanted, shape (n,), rad/s^2.
        """
        self._turn = (self._turn + 1) % len(FACTORS)
        other = self._time * FACTORS[self._turn]
        if self._take(a, other):
            self.outcomes["as wanted"] += 1
            return a
        if self.lost and np.isfinite(a).all():
            self.outcomes["outside"] += 1
            self.reset()
            return a
        plan, low, high = self.plan, 0.0, 1.0
        for _ in range(HALVINGS):
            share = 0.5 * (low + high)
            if self._safe(plan + share * (a - plan), self._rest):
                low = share
            else:
                high = share
        self.outcomes["changed" if low > 0.0 else "planned"] += 1
        chosen = plan + low * (a - plan) if low > 0.0 else plan
        # The rest of the plan is safe. At rest it would end in plans too short to begin from.
        time = max(self._time - self._dt, self._dt)
        if not self._take(chosen, max(time, other)):
            self._time = time
            copy_course(self._rest, self._course)
        return chosen

    def _keep(self, T: float) -> None:
        """Keep the plan that was looked at last."""
        self._time = T
        copy_course(self._plans.course, self._course)

    def _take(self, a: Array, other: float) -> bool:
        """Take the plan after a step of `a` that needs least, of those that are safe.

        Besides the time of the plan in hand and its rest, the time `other` is tried, s. Returns
        False without a safe plan.
        """
        best, now, taken = np.inf, self._time, False
        for T, course in (
            (now, None),
            (other, None),
            (max(now - self._dt, self._dt), self._rest),
        ):
            if self._dt <= T <= LONGEST and self._safe(a, course or T):
                cost = self._plans.cost + PULL * log(T / self.usual) ** 2
                if now != T and abs(log(T / self.usual)) >= abs(log(now / self.usual)):
                    cost *= 1.0 + RELUCTANCE  # not back to usual: at rest nothing else leads there
                if cost < best:
                    best, taken = cost, True
                    self._keep(T)
        return taken

    def _safe(self, a: Array, plan: float | Course) -> bool:
        """Return whether a plan after a step is within the limits.

        Where the plan in hand is not, because of a disturbance, it must not be worse. The plan is
        given by its time, s, or by its course.
        """
        plans, begin = self._plans, self._state
        q, v = begin.after(a, self._dt)
        if isinstance(plan, float):
            plans.plan(q, v, a, plan, self._gentle, self._extra, begin)
        else:
            plans.follow(q, v, a, plan, self._extra, begin)
        return self._now.cover(plans)
