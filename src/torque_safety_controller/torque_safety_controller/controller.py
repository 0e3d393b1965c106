# SPDX-License-Identifier: Apache-2.0
"""The controller of one arm: state, limits and an order in, torque out; no ROS."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from torque_safety_controller.limiter import TorqueLimiter
from torque_safety_controller.parts.goals import Goals
from torque_safety_controller.qp import (
    AccelerationRange,
    InverseDynamicsQP,
    NoSolutionFound,
    Solution,
)
from torque_safety_controller.robot_model import RobotModel
from torque_safety_controller.step import Part, Settings, Step
from torque_safety_controller.supervisor import Order
from viability_bounds_pkg.state import State

Array = NDArray[np.float64]
_SERVE = Order()
Kind = TypeVar("Kind")


class Controller:
    """Torques that move an arm towards its goals inside every limit.

    Args:
        robot: model of the arm.
        parts: what it can do, in the order in which it is done; `Goals` is one of them.
        tau_max: torque limits, shape (n,), N m.
        torque_rate_max: greatest change of torque, shape (n,), N m/s; inf for none.
        solver: of the QP, one of `qp.SOLVERS`.
        hold_kd: damping of an arm without a goal, 1/s; may be changed between steps.

    Attributes:
        robot, parts, hold_kd: as given.
        goals: of the end effectors and the joints, from `parts`.
    """

    def __init__(
        self,
        robot: RobotModel,
        parts: Sequence[Part],
        tau_max: ArrayLike,
        torque_rate_max: ArrayLike | None = None,
        solver: str = "daqp",
        hold_kd: float = 20.0,
    ) -> None:
        self.robot = robot
        self.parts = tuple(parts)
        self._prepare, self._choose, self._learn = (
            [getattr(part, name) for part in parts if getattr(type(part), name) is not nothing]
            for name, nothing in (
                ("prepare", Part.prepare),
                ("choose", Part.choose),
                ("learn", Part.learn),
            )
        )
        self.hold_kd = hold_kd
        (self.goals,) = (part for part in parts if isinstance(part, Goals))
        self._limiter = TorqueLimiter(tau_max, torque_rate_max, robot.dt)
        self._qp = InverseDynamicsQP(robot.n, solver=solver)
        self._a_last = np.zeros(robot.n)

    @property
    def tau_max(self) -> Array:
        """Torque limits, shape (n,), N m."""
        return self._limiter.tau_max

    def find(self, kind: type[Kind]) -> Kind | None:
        """Return the part of a class; None if that is off."""
        return next((part for part in self.parts if isinstance(part, kind)), None)

    def configure(self, settings: Settings) -> None:
        """Go by changed settings from the next step on."""
        self.hold_kd = settings.gains.hold_kd
        for part in self.parts:
            part.configure(settings)

    def remodel(self) -> None:
        """Go by a model whose masses or placements have changed from the next step on."""
        for part in self.parts:
            part.remodel(self.robot)

    def reset(self, q: Array) -> None:
        """Forget the past; the null space is held at `q`, where the arm is, shape (n,), rad."""
        self._a_last = np.zeros(self.robot.n)
        self._limiter.reset()
        self.robot.update(State(q, np.zeros(self.robot.n)), self._a_last)
        for part in self.parts:
            part.reset(self.robot)

    def step(
        self,
        state: State,
        limits: AccelerationRange | None,
        order: Order | None = None,
        elapsed: float | None = None,
    ) -> Step:
        """Return one control step, decided: its torque is `Step.tau`.

        Without a goal the arm is brought to rest, by gravity compensation and damping; when the
        QP has no solution, too.

        Args:
            state: of the arm now.
            limits: of the accelerations; None for the controller's own.
            order: of the supervisor; None to serve the goals.
            elapsed: time since the last step, s; None for a control period.
        """
        elapsed = self.robot.dt if elapsed is None else elapsed
        step = self._decide(state, limits, order or _SERVE, elapsed)
        self._command(step)
        for learn in self._learn:
            learn(step)
        return step

    def resume(self, state: State, limits: AccelerationRange, tau: Array) -> Step:
        """Prepare to continue the torque that something else applies: [Benallegue2021], IV-A.

        The arm's poses and posture become the goals. The QP gives the torque for them; parts
        begin with the difference, so that the next step continues `tau`. When the QP has no
        solution, or `tau` is not finite, the goals stay what they were.

        Args:
            state: of the arm now.
            limits: of the accelerations.
            tau: torque of the motors now, shape (n,), N m.

        Returns:
            The step, with its `failure`; nothing is to be commanded by it.
        """
        before = self.goals.targets, self.goals.posture
        self.reset(state.q)
        self.goals.hold_here(self.robot)
        step = self._decide(state, limits, _SERVE, elapsed=0.0)
        if not step.failure and not np.isfinite(tau).all():
            step.failure = "the torque of the motors is not finite"
        if step.failure:
            self.goals.targets, self.goals.posture = before
            return step
        self._command(step)
        beyond = self._limiter.continue_from(tau) - step.tau
        for part in self.parts:
            part.resume(step, beyond)
        return step

    def warm_up(self) -> None:
        """Run a step of each kind once, so that nothing is compiled or loaded in a control loop.

        Call it before anything else; it leaves no trace.
        """
        zero = np.zeros(self.robot.n)
        state = State(zero, zero)
        self.reset(zero)
        before = self.goals.targets
        for width in (1e3, 0.0):  # with no room, limits are relaxed
            self.goals.hold_here(self.robot)
            self.step(state, AccelerationRange(zero - width, zero + width))
        self.step(state, None)
        self.resume(state, AccelerationRange(zero - 1e3, zero + 1e3), zero)
        self.goals.targets = before
        self.reset(zero)

    def report(self) -> dict[str, Any]:
        """Return the values of all parts for diagnostics, by name."""
        return {name: value for part in self.parts for name, value in part.report().items()}

    def _decide(
        self, state: State, limits: AccelerationRange | None, order: Order, elapsed: float
    ) -> Step:
        """Return a step of which the accelerations to command are known."""
        self.robot.update(state, self._a_last)
        step = Step(self.robot, limits, order, elapsed, self.tau_max, self._a_last, self.hold_kd)
        for prepare in self._prepare:
            prepare(step)
        try:
            step.solution = self._solve(step)
            a = step.solution.a
        except NoSolutionFound as error:
            step.failure, step.tracking = str(error), False
            a = step.rest
            if not np.isfinite(step.torque).all():
                step.torque = np.zeros(self.robot.n)
        for choose in self._choose:
            a = choose(step, a)
        step.a = a if math.isfinite(a.dot(a)) else np.zeros(self.robot.n)
        return step

    def _solve(self, step: Step) -> Solution:
        """Return the commanded accelerations that serve the tasks best.

        They are within the eased bounds, else within the bounds, else within what the fallback
        widens them to; bounds and rows are relaxed least where the torque limits ask for it.

        Raises:
            NoSolutionFound: numbers that are not finite or absurd, or no task with a weight.
        """
        robot, solve = self.robot, self._qp.solve
        terms = [task.term(robot) for task in step.tasks]
        torques = robot.M, robot.h + step.torque, *self._limiter.range(), step.forces
        rows = step.commanded_rows() if step.rows else None
        if step.eased is not None:
            solution = solve(terms, *torques, step.eased, rows)
            if solution.exact:
                return solution
        bounds = step.commanded(step.bounds)
        solution = solve(terms, *torques, bounds, rows)
        if solution.relaxation is None or step.fallback is None:
            return solution
        # Rows with an upper limit lead back from where too little torque is left, which the
        # fallback need not; those of distances have none, and are kept.
        plan = step.fallback - step.disturbance
        widened = AccelerationRange(np.minimum(bounds.lower, plan), np.maximum(bounds.upper, plan))
        if rows is not None:
            there = rows.G @ plan
            lower = np.where(np.isfinite(rows.upper), np.minimum(rows.lower, there), rows.lower)
            rows = rows._replace(lower=lower, upper=np.maximum(rows.upper, there))
        return solve(terms, *torques, widened, rows)

    def _command(self, step: Step) -> None:
        """Find the torque of a step, and remember its accelerations."""
        wanted = self.robot.torque(step.a) + step.torque
        if step.forces is not None and step.solution is not None:
            wanted = wanted - step.forces.B @ step.solution.rho
        step.tau = self._limiter.limited(wanted)
        if step.failure and np.isfinite(wanted).all() and (step.tau != wanted).any():
            # What the motors cannot give is no error for the integral to grow on.
            step.a = step.a + np.linalg.solve(self.robot.M, step.tau - wanted)
        self._a_last = step.a
