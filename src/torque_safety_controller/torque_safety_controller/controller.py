"""State, limits and goals in, torque out; no ROS."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from copy import copy
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from torque_safety_controller.additional_torque import (
    LONGEST_GAP,
    AdditionalTorque,
)
from torque_safety_controller.collision.avoidance import CollisionAvoidance
from torque_safety_controller.contact.interaction import Interaction
from torque_safety_controller.qp.inverse_dynamics_qp import (
    ContactForces,
    InverseDynamicsQP,
    NoSolutionFound,
)
from torque_safety_controller.robot_model import RobotModel
from torque_safety_controller.safety.disturbance_observer import DisturbanceObserver
from torque_safety_controller.safety.torque_limiter import TorqueLimiter
from torque_safety_controller.tasks.gains import Gains
from torque_safety_controller.tasks.goals import Goals
from torque_safety_controller.tasks.tasks import TaskTerm, damping_task

__all__ = ["Controller", "Gains", "Step"]


class Step(NamedTuple):
    """One control step.

    Attributes:
        tau: torque, shape (n,), N m, finite and within the limits.
        a: accelerations that it is to give, shape (n,), rad/s^2.
        tracking: whether the tasks were served; False when the arm only holds still.
        relaxation: by how much the acceleration bounds had to give way to the torque limits,
            shape (n,), rad/s^2, or None.
        failure: why the QP was not used though it could have been, or empty.
        row_relaxation: by how much distances had to give way, one for each row of the collision
            avoidance, scaled m/s^2, or None.
    """

    tau: np.ndarray
    a: np.ndarray
    tracking: bool
    relaxation: np.ndarray | None = None
    failure: str = ""
    row_relaxation: np.ndarray | None = None


class Controller:
    """Torques that move an arm towards its goals inside every limit.

    Args:
        robot: model of the arm.
        tau_max: torque limits, shape (n,), N m.
        gains: initial gains.
        torque_rate_max: greatest change of torque, shape (n,), N m/s; inf for none.
        additional: integral action; the torque limits hold with it counted in.
        solver: of the QP, one of `inverse_dynamics_qp.SOLVERS`.
        collision: keeps links apart and away from obstacles; None for nothing.
        interaction: what is done about forces at the hand and other contacts; None for nothing.

    Attributes:
        goals: of the end effector and the joints.
        additional, collision, interaction: as given.
        iterations: of the last QP.
    """

    def __init__(
        self,
        robot: RobotModel,
        tau_max: np.ndarray,
        gains: Gains,
        torque_rate_max: np.ndarray | None = None,
        additional: AdditionalTorque | None = None,
        solver: str = "active_set",
        collision: CollisionAvoidance | None = None,
        interaction: Interaction | None = None,
    ) -> None:
        n = robot.n
        self.robot = robot
        self.gains = gains
        self.goals = Goals(n)
        self.additional = additional
        self.collision = collision
        self.interaction = interaction
        self.iterations = 0
        self._limiter = TorqueLimiter(tau_max, torque_rate_max, robot.dt)
        self._qp = InverseDynamicsQP(n, solver=solver)
        self._observer = DisturbanceObserver(n, gains.disturbance_time)
        self._a_last = np.zeros(n)

    @property
    def tau_max(self) -> np.ndarray:
        """Torque limits, shape (n,), N m."""
        return self._limiter.tau_max

    @property
    def acceleration(self) -> np.ndarray:
        """Acceleration commanded last, shape (n,), rad/s^2."""
        return self._a_last

    def start(self, q: np.ndarray) -> None:
        """Forget the past; `q` becomes the posture that the null space is held at."""
        self._forget()
        self.goals.posture = q.copy()

    def _forget(self) -> None:
        self._a_last = np.zeros(self.robot.n)
        self._limiter.reset()
        self._observer.reset()
        if self.additional is not None:
            self.additional.reset()
        if self.interaction is not None:
            self.interaction.start()

    def set_pose_goal(
        self,
        pose_des: pin.SE3,
        twist: np.ndarray | None = None,
        twist_rate: np.ndarray | None = None,
    ) -> None:
        """Move the end effector to `pose_des`; see `Goals.set_pose`."""
        self.goals.set_pose(pose_des, twist, twist_rate)

    def set_posture_goal(self, q_des: np.ndarray, v_des: np.ndarray | None = None) -> None:
        """Bring the joints to `q_des`; see `Goals.set_posture`."""
        self.goals.set_posture(q_des, v_des)

    def warm_up(self) -> None:
        """Run every part of a step once: what is compiled at first use is compiled now.

        Call it before anything else; it leaves no trace.
        """
        q = v = np.zeros(self.robot.n)
        wide = np.full(self.robot.n, 1e3)
        for bounds in (wide, 0.0 * wide):  # zero bounds take the solver proper
            self.robot.update(q, v, v)
            self.set_pose_goal(self.robot.pose.copy())
            self.step(q, v, -bounds, bounds)
        if self.interaction is not None:
            tasks, contacts = self.interaction.rehearsal(self.robot, self.gains)
            self._solve(q, v, tasks, -wide, wide, None, contacts)
        self.goals = Goals(self.robot.n)
        self.robot.rates = self.additional is not None
        self.robot.update(q, v, v)
        self.start(q)

    def step(
        self,
        q: np.ndarray,
        v: np.ndarray,
        a_lower: np.ndarray,
        a_upper: np.ndarray,
        elapsed: float | None = None,
    ) -> Step:
        """Return the torque for one control step towards the goals.

        Without a goal it is `rest`; when the QP fails, `hold`.

        Args:
            q: position, shape (n,), rad.
            v: velocity, shape (n,), rad/s.
            a_lower: acceleration bounds, shape (n,), rad/s^2.
            a_upper: shape (n,), rad/s^2, not below `a_lower`.
            elapsed: time since the last step, s; None for a control period.
        """
        if not self.goals.any:
            return self.rest(q, v, a_lower, a_upper, elapsed)
        additional = self._begin(q, v, elapsed)
        tasks, contacts = self._tasks(q, v)
        return self._solve(q, v, tasks, a_lower, a_upper, additional, contacts)

    def rest(
        self,
        q: np.ndarray,
        v: np.ndarray,
        a_lower: np.ndarray,
        a_upper: np.ndarray,
        elapsed: float | None = None,
    ) -> Step:
        """Return the torque that brings the arm to rest inside its bounds; see `step`."""
        additional = self._begin(q, v, elapsed)
        tasks = [damping_task(v, self.gains.hold_kd)]
        step = self._solve(q, v, tasks, a_lower, a_upper, additional)
        return step._replace(tracking=False)

    def take_over(
        self,
        q: np.ndarray,
        v: np.ndarray,
        a_lower: np.ndarray,
        a_upper: np.ndarray,
        tau: np.ndarray,
    ) -> Step:
        """Prepare to go on from torque that something else applies: [Benallegue2021], IV-A.

        The arm's pose and posture become the goals. What is asked for then is given by the QP;
        the additional torque begins with the difference, so that the next step continues `tau`.
        When the QP fails, or `tau` is not finite, the goals stay what they were.

        Args:
            q: position, shape (n,), rad.
            v: velocity, shape (n,), rad/s.
            a_lower: acceleration bounds, shape (n,), rad/s^2.
            a_upper: shape (n,), rad/s^2, not below `a_lower`.
            tau: torque of the motors now, shape (n,), N m.
        """
        self._forget()
        self.robot.rates = self.additional is not None
        self.robot.update(q, v, self._a_last)
        here = copy(self.goals)
        here.posture = q.copy()
        here.set_posture(q.copy())
        here.hold(self.robot.pose)
        tasks = here.tasks(self.robot, q, v, self.gains)
        step = self._solve(q, v, tasks, a_lower, a_upper, None)
        if not step.failure and not np.isfinite(tau).all():
            step = step._replace(failure="the torque of the motors is not finite")
        if step.failure:
            return step
        self.goals = here
        self._limiter.go_on_from(tau)
        if self.additional is not None:
            self.additional.initialise(self.robot, v, self._limiter.last - step.tau)
        return step

    def hold(self, q: np.ndarray, v: np.ndarray, elapsed: float | None = None) -> Step:
        """Return a torque that needs no acceleration bounds: gravity and damping.

        Each joint brakes with `hold_kd`, as hard as its motor allows.
        """
        return self._hold(q, v, self._begin(q, v, elapsed), "")

    def _begin(self, q: np.ndarray, v: np.ndarray, elapsed: float | None) -> np.ndarray | None:
        """Update the model and return the additional torque of a step, or None."""
        robot, additional = self.robot, self.additional
        robot.rates = additional is not None and not additional.idle
        robot.update(q, v, self._a_last)
        elapsed = robot.dt if elapsed is None else elapsed
        observer = self._observer
        observer.time_constant = self.gains.disturbance_time
        known = elapsed if elapsed <= LONGEST_GAP * robot.dt else 0.0
        observer.observe(v, self._a_last, known, self.tau_max, robot.M)
        if self.interaction is not None:
            self.interaction.observe(robot, self.goals, elapsed)
        if not robot.rates:
            return None
        return additional.torque(robot, v, self._a_last, elapsed)

    def _tasks(self, q: np.ndarray, v: np.ndarray) -> tuple[list[TaskTerm], ContactForces | None]:
        """Return the tasks of a step, and the forces that contacts may exert."""
        robot, goals, gains, interaction = self.robot, self.goals, self.gains, self.interaction
        if interaction is None:
            return goals.tasks(robot, q, v, gains), None
        tasks = goals.tasks(robot, q, v, gains, interaction.stiffness)
        tasks += interaction.tasks(robot, gains)
        return tasks, interaction.forces(robot)

    def _solve(
        self,
        q: np.ndarray,
        v: np.ndarray,
        tasks: Sequence[TaskTerm],
        a_lower: np.ndarray,
        a_upper: np.ndarray,
        additional: np.ndarray | None,
        contacts: ContactForces | None = None,
    ) -> Step:
        robot = self.robot
        bias = robot.h if additional is None else robot.h + additional
        lower, upper = self._limiter.range()
        a_lower, a_upper = self._observer.shift(a_lower, a_upper)
        rows = None
        if self.collision is not None:
            rows = self.collision.constraint(q, v, a_lower, a_upper, self._observer.known)
        try:
            solution = self._qp.solve(
                tasks, a_lower, a_upper, robot.M, lower - bias, upper - bias, rows, contacts
            )
        except NoSolutionFound as error:
            return self._hold(q, v, additional, str(error))
        self.iterations = solution.iterations
        tau = robot.torque(q, v, solution.a)
        if additional is not None:
            tau = tau + additional
        if contacts is not None:
            tau = tau - solution.contact_torque
            self.interaction.note_forces(solution.rho)
        return Step(
            self._limiter.limited(tau),
            self._remember(solution.a),
            True,
            solution.relaxation,
            row_relaxation=solution.row_relaxation,
        )

    def _hold(
        self, q: np.ndarray, v: np.ndarray, additional: np.ndarray | None, failure: str
    ) -> Step:
        robot = self.robot
        self._observer.reset()  # what is asked for here may be more than the motors can give
        a = -self.gains.hold_kd * v
        bias = robot.h
        if additional is not None and np.isfinite(additional).all():
            bias = robot.h + additional
        tau = robot.M @ a + bias
        sent = self._limiter.limited(tau)
        if not np.array_equal(sent, tau):
            # What the motors cannot give is no error for the integral to grow on.
            with suppress(np.linalg.LinAlgError):
                a = np.linalg.solve(robot.M, sent - bias)
        return Step(sent, self._remember(a), False, None, failure)

    def _remember(self, a: np.ndarray) -> np.ndarray:
        self._a_last = a if math.isfinite(a.dot(a)) else np.zeros(self.robot.n)
        return self._a_last
