# SPDX-License-Identifier: Apache-2.0
"""The controller of one arm: state, limits and goals in, torque out; no ROS."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from copy import copy
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from torque_safety_controller.contact.interaction import Interaction
from torque_safety_controller.friction.compensation import FrictionCompensation
from torque_safety_controller.integral_feedback.action import LONGEST_GAP, FadingTorque
from torque_safety_controller.limiter import TorqueLimiter
from torque_safety_controller.qp import (
    AccelerationRange,
    Constraint,
    ContactForces,
    InverseDynamicsQP,
    LinearConstraints,
    NoSolutionFound,
    Solution,
    stack_constraints,
)
from torque_safety_controller.robot_model import RobotModel
from torque_safety_controller.safety.disturbance_observer import DisturbanceObserver
from torque_safety_controller.slow_down import SlowDown
from torque_safety_controller.supervisor import Order
from torque_safety_controller.tasks.damping_task import DampingTask
from torque_safety_controller.tasks.gains import Gains
from torque_safety_controller.tasks.goals import Goals
from torque_safety_controller.tasks.task import Task
from viability_bounds_pkg.state import State
from viability_bounds_pkg.viability import AccelerationBounds
from viability_bounds_pkg.whole_arm.safety_filter import SafetyFilter

__all__ = ["ControlOutput", "Controller", "Gains"]

Array = NDArray[np.float64]


class ControlOutput(NamedTuple):
    """Result of one control step.

    Attributes:
        tau: torque, shape (n,), N m, finite and within the limits.
        a: accelerations that it is to give, shape (n,), rad/s^2.
        tracking: whether the tasks were served; False when the arm only brakes.
        relaxation: by how much the acceleration bounds had to be relaxed for the torque limits,
            shape (n,), rad/s^2, or None.
        failure: why the QP was not used though it could have been, or empty.
        constraint_relaxation: by how much distances had to be relaxed, one for each row of the
            collision avoidance, scaled m/s^2, or None.
    """

    tau: Array
    a: Array
    tracking: bool
    relaxation: Array | None = None
    failure: str = ""
    constraint_relaxation: Array | None = None


class Controller:
    """Torques that move an arm towards its goals inside every limit.

    Args:
        robot: model of the arm.
        tau_max: torque limits, shape (n,), N m.
        gains: initial gains.
        torque_rate_max: greatest change of torque, shape (n,), N m/s; inf for none.
        integral: integral action; the torque limits hold with it counted in.
        friction: friction compensation; likewise.
        solver: of the QP, one of `inverse_dynamics_qp.SOLVERS`.
        constraints: on the accelerations, besides bounds and torque limits.
        interaction: forces at the hand and other contacts; None for nothing.
        safety_filter: keeps a plan in hand that keeps all limits; None for nothing.
        own_bounds: within which it brakes while it is given no acceleration bounds; None brakes
            regardless of positions and speeds.
        position_limits: without margins, lower and upper, shape (n,), rad; while it is slowed it
            brakes gently within the margins, which None forbids.

    Attributes:
        goals: of the end effector and the joints.
        integral, friction, constraints, interaction, safety_filter: as given.
        iterations: of the last QP.
    """

    def __init__(
        self,
        robot: RobotModel,
        tau_max: Array,
        gains: Gains,
        torque_rate_max: Array | None = None,
        integral: FadingTorque | None = None,
        friction: FrictionCompensation | None = None,
        solver: str = "daqp",
        constraints: Sequence[Constraint] = (),
        interaction: Interaction | None = None,
        safety_filter: SafetyFilter | None = None,
        own_bounds: Callable[[Array, Array], AccelerationBounds] | None = None,
        position_limits: tuple[Array, Array] | None = None,
    ) -> None:
        n = robot.n
        self.robot = robot
        self.gains = gains
        self.goals = Goals(n, len(robot.others))
        self.integral = integral
        self.friction = friction
        self.constraints = constraints
        self.interaction = interaction
        self.safety_filter = safety_filter
        self.iterations = 0
        self._own_bounds = own_bounds
        self._slow_down = SlowDown(position_limits, robot.dt)
        self._order = Order()
        self._limiter = TorqueLimiter(tau_max, torque_rate_max, robot.dt)
        self._qp = InverseDynamicsQP(n, solver=solver)
        self._observer = DisturbanceObserver(n, gains.disturbance_time)
        self._a_last = np.zeros(n)
        self._no_torque = np.zeros(n)
        free = np.full(n, np.inf)
        self._any_acceleration = AccelerationRange(-free, free)

    @property
    def tau_max(self) -> Array:
        """Torque limits, shape (n,), N m."""
        return self._limiter.tau_max

    @property
    def acceleration(self) -> Array:
        """Acceleration commanded last, shape (n,), rad/s^2."""
        return self._a_last

    @property
    def lost(self) -> bool:
        """Whether the safety filter knows no plan near the limits, so that the arm only brakes."""
        return self.safety_filter is not None and self.safety_filter.lost

    def reset(self, q: Array) -> None:
        """Forget the past; `q` becomes the posture that the null space is held at."""
        self._forget()
        self.goals.posture = q.copy()

    @property
    def integral_gain(self) -> float:
        """Gain of the integral action that is used here, 1/s; 0 without one."""
        return 0.0 if self.integral is None else self.integral.gain

    def _forget(self) -> None:
        self._a_last = np.zeros(self.robot.n)
        self._limiter.reset()
        self._observer.reset()
        if self.integral is not None:
            self.integral.reset()
        if self.friction is not None:
            self.friction.reset()
        if self.interaction is not None:
            self.interaction.start()
        if self.safety_filter is not None:
            self.safety_filter.reset()

    def set_pose_goal(
        self,
        pose_des: pin.SE3,
        twist: Array | None = None,
        twist_rate: Array | None = None,
    ) -> None:
        """Move the end effector to `pose_des`; see `Goals.set_pose`."""
        self.goals.set_pose(pose_des, twist, twist_rate)

    def set_other_pose_goal(self, hand: int, pose_des: pin.SE3) -> None:
        """Move a further end effector to `pose_des`; see `Goals.set_other_pose`."""
        self.goals.set_other_pose(hand, pose_des)

    def set_posture_goal(
        self, q_des: Array, v_des: Array | None = None, a_des: Array | None = None
    ) -> None:
        """Bring the joints to `q_des`; see `Goals.set_posture`."""
        self.goals.set_posture(q_des, v_des, a_des)

    def release_pose_goal(self) -> None:
        """Leave the end effector without a goal; see `Goals.release_pose`."""
        self.goals.release_pose()

    def warm_up(self) -> None:
        """Run every part of a step once: what is compiled at first use is compiled now.

        Call it before anything else; it leaves no trace.
        """
        zero = np.zeros(self.robot.n)
        state = State(zero, zero)
        wide = AccelerationRange(zero - 1e3, zero + 1e3)
        for bounds in (wide, AccelerationRange(zero, zero)):
            self.robot.update(state, zero)
            self.set_pose_goal(self.robot.pose.copy())
            self.step(state, bounds)
        if self.interaction is not None:
            tasks, contacts = self.interaction.rehearsal(self.robot, self.gains)
            self._solve(tasks, wide, None, contacts)
        self.goals = Goals(self.robot.n, len(self.robot.others))
        self.robot.rates = self.integral is not None and self.integral.rates
        self.robot.update(state, zero)
        self.reset(zero)
        if self.safety_filter is not None:
            self.safety_filter.outcomes.clear()

    def step(
        self,
        state: State,
        limits: AccelerationRange | None,
        order: Order | None = None,
        elapsed: float | None = None,
    ) -> ControlOutput:
        """Return the torque for one control step.

        Without a goal the arm is brought to rest; when the QP fails, too: by gravity
        compensation and damping.

        Args:
            state: of the arm now.
            limits: of the accelerations; None for the controller's own.
            order: of the supervisor; None to serve the goals.
            elapsed: time since the last step, s; None for a control period.
        """
        self._order = order = order or Order()
        if order.forget_disturbance:
            self._observer.reset()
        if order.forget_integral and self.integral is not None:
            self.integral.forget()
        additional = self._begin(state, elapsed)
        if limits is None:
            if self._own_bounds is None:
                return self._hold(additional, "")
            lower, upper, _ = self._own_bounds(state.q, state.v)
            limits = AccelerationRange(lower, upper)
        if order.track and self.goals.any:
            tasks, contacts = self._tasks()
            return self._solve(tasks, limits, additional, contacts)
        output = self._solve([DampingTask(self.gains.hold_kd)], limits, additional)
        return output._replace(tracking=False)

    def bumpless_transfer(
        self, state: State, bounds: AccelerationRange, tau: Array
    ) -> ControlOutput:
        """Prepare to continue the torque that something else applies: [Benallegue2021], IV-A.

        The arm's pose and posture become the goals. The QP gives the torque for them; the
        additional torque begins with the difference, so that the next step continues `tau`.
        When the QP fails, or `tau` is not finite, the goals stay what they were.

        Args:
            state: of the arm now.
            bounds: of the accelerations.
            tau: torque of the motors now, shape (n,), N m.
        """
        self._forget()
        self._order = Order()
        self.robot.rates = self.integral is not None and self.integral.rates
        self.robot.update(state, self._a_last)
        here = copy(self.goals)
        here.posture = state.q.copy()
        here.set_posture(state.q.copy())
        here.hold(self.robot.pose)
        here.hold_others([hand.pose for hand in self.robot.others])
        output = self._solve(here.tasks(self.gains), bounds, None)
        if not output.failure and not np.isfinite(tau).all():
            output = output._replace(failure="the torque of the motors is not finite")
        if output.failure:
            return output
        self.goals = here
        last = self._limiter.go_on_from(tau)
        if self.integral is not None:
            self.integral.resume(self.robot, state.v, last - output.tau)
        return output

    def _begin(self, state: State, elapsed: float | None) -> Array | None:
        """Update the model and return the additional torque of a step, or None."""
        robot, integral, friction = self.robot, self.integral, self.friction
        robot.rates = integral is not None and integral.rates
        robot.update(state, self._a_last)
        elapsed = robot.dt if elapsed is None else elapsed
        observer, obeyed = self._observer, self._order.obeyed
        observer.time_constant = self.gains.disturbance_time
        known = elapsed if obeyed and 0.0 < elapsed <= LONGEST_GAP * robot.dt else 0.0
        observer.observe(robot.v, self._a_last, known, self.tau_max, robot.M)
        if self.interaction is not None:
            self.interaction.observe(robot, self.goals, elapsed)
        if integral is None and friction is None:
            return None
        torque = self._no_torque
        if integral is not None:
            before, time = integral.last, elapsed if obeyed else math.inf
            torque = integral.torque(robot, robot.v, self._a_last, time)
            observer.expect(torque - before, self.tau_max, robot.M)
        if friction is not None:
            torque = torque + friction.torque(robot.M, robot.v, self._a_last, known, robot.dt)
        return torque

    def _tasks(self) -> tuple[list[Task], ContactForces | None]:
        """Return the tasks of a step, and the forces that contacts may exert."""
        gains, interaction = self.gains, self.interaction
        if interaction is None:
            return self.goals.tasks(gains), None
        tasks, forced = self.goals.tasks(gains, interaction.stiffness), interaction.tasks(gains)
        return tasks + forced, interaction.forces(self.robot)

    def _solve(
        self,
        tasks: Sequence[Task],
        bounds: AccelerationRange,
        additional: Array | None,
        contacts: ContactForces | None = None,
    ) -> ControlOutput:
        robot, qp, share = self.robot, self._qp, self._order.share
        bias = robot.h if additional is None else robot.h + additional
        lower, upper = self._limiter.range()
        disturbance = self._observer.known
        rows = self._look_ahead(bounds, additional, disturbance)
        if self.safety_filter is not None:
            bounds = AccelerationRange(self.safety_filter.lower, self.safety_filter.upper)
            if self.lost:
                tasks = [DampingTask(self.gains.hold_kd)]
        else:
            bounds = self._slow_down.return_bounds(bounds, robot.q, robot.v, share)
        if disturbance is not None:
            bounds = AccelerationRange(*self._observer.shift(*bounds))
        parts = [each.constraint(robot, bounds, disturbance) for each in self.constraints]
        terms = [task.term(robot) for task in tasks]
        eased = bounds
        if share < 1.0:
            rest = -self.gains.hold_kd * robot.v
            terms = self._slow_down.tasks(terms, rest, share)
            eased = self._slow_down.bounds(bounds, rest, share)

        def solve(bounds: AccelerationRange, rows: LinearConstraints | None) -> Solution:
            constraints = stack_constraints([*parts, rows])
            return qp.solve(
                qp.build(terms, bounds, robot.M, lower - bias, upper - bias, constraints, contacts)
            )

        try:
            solution = solve(eased, rows)
            exact = solution.relaxation is None and solution.constraint_relaxation is None
            if eased is not bounds and not exact:
                solution = solve(bounds, rows)  # narrower bounds are a wish only
            lacking = solution.relaxation is not None and not self.lost
            if self.safety_filter is not None and lacking:
                # The bounds have margins that the plan does not keep, and rows lead back
                # from where it leaves too little. With the plan allowed there is a solution.
                plan = self.safety_filter.plan
                if disturbance is not None:
                    plan = plan - disturbance
                low, high = np.minimum(bounds.lower, plan), np.maximum(bounds.upper, plan)
                if rows is not None:
                    rows = rows._replace(upper=np.maximum(rows.upper, rows.G @ plan))
                solution = solve(AccelerationRange(low, high), rows)
        except NoSolutionFound as error:
            return self._hold(additional, str(error))
        self.iterations = solution.iterations
        a = solution.a
        if self.safety_filter is not None:
            a = _chosen(self.safety_filter, a, disturbance)
        tau = robot.torque(a)
        if additional is not None:
            tau = tau + additional
        if contacts is not None:
            tau = tau - contacts.B @ solution.rho
            if self.interaction is not None:
                self.interaction.note_forces(solution.rho)
        a = self._remember(a)
        tau = self._limiter.limited(tau)
        relaxed = solution.constraint_relaxation
        if relaxed is not None and rows is not None:
            relaxed = relaxed[: -len(rows.G)] if len(relaxed) > len(rows.G) else None
        return ControlOutput(tau, a, not self.lost, solution.relaxation, "", relaxed)

    def _look_ahead(
        self, bounds: AccelerationRange, additional: Array | None, disturbance: Array | None
    ) -> LinearConstraints | None:
        """Prepare the filter; return its constraints on the commanded accelerations."""
        if self.safety_filter is None:
            return None
        robot = self.robot
        extra = self._no_torque if additional is None else additional
        if disturbance is not None:
            extra = extra - robot.M @ disturbance
        rows = self.safety_filter.prepare(robot.q, robot.v, extra, *bounds)
        if rows is None:
            return None
        G, upper = rows
        if disturbance is not None:
            upper = upper - G @ disturbance
        return LinearConstraints(G, np.full(len(upper), -np.inf), upper)

    def _hold(self, additional: Array | None, failure: str) -> ControlOutput:
        robot = self.robot
        self._observer.pause()  # what is asked for here may be more than the motors can give
        a = -self.gains.hold_kd * robot.v
        if self.safety_filter is not None:
            self._look_ahead(self._any_acceleration, additional, None)
            a = self.safety_filter.choose(a)
        bias = robot.h
        if additional is not None and np.isfinite(additional).all():
            bias = robot.h + additional
        tau = robot.M @ a + bias
        sent = self._limiter.limited(tau)
        if not np.array_equal(sent, tau):
            # What the motors cannot give is no error for the integral to grow on.
            with suppress(np.linalg.LinAlgError):
                a = np.linalg.solve(robot.M, sent - bias)
        return ControlOutput(sent, self._remember(a), False, None, failure)

    def _remember(self, a: Array) -> Array:
        self._a_last = a if math.isfinite(a.dot(a)) else np.zeros(self.robot.n)
        return self._a_last


def _chosen(safety_filter: SafetyFilter, a: Array, disturbance: Array | None) -> Array:
    """Return the acceleration to command in place of `a`."""
    if disturbance is None:
        return safety_filter.choose(a)
    return safety_filter.choose(a + disturbance) - disturbance
