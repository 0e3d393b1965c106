"""State, limits and goals in, torque out; no ROS."""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from torque_safety_controller.additional_torque import LONGEST_GAP, AdditionalTorque
from torque_safety_controller.disturbance_observer import DisturbanceObserver
from torque_safety_controller.inverse_dynamics_qp import InverseDynamicsQP, NoSolutionFound
from torque_safety_controller.robot_model import RobotModel
from torque_safety_controller.tasks import (
    TaskTerm,
    damping_task,
    pose_error,
    pose_feed_forward,
    pose_task,
    posture_task,
)


@dataclass(frozen=True)
class Gains:
    """What may change while the controller runs.

    Attributes:
        pose_kp, pose_kd: of the pose task, 1/s^2 and 1/s.
        pose_weight: of the pose task; 0 leaves the task out.
        posture_kp, posture_kd: of the posture task, 1/s^2 and 1/s.
        posture_weight: of the posture task, > 0.
        posture_in_null_space: whether the posture leaves the pose alone.
        hold_kd: damping in HOLD, 1/s.
        disturbance_time: time constant with which what disturbs the accelerations is learned
            and kept out of the bounds, s; None not to.
    """

    pose_kp: float
    pose_kd: float
    pose_weight: float
    posture_kp: float
    posture_kd: float
    posture_weight: float
    posture_in_null_space: bool
    hold_kd: float
    disturbance_time: float | None = None


class Step(NamedTuple):
    """One control step.

    Attributes:
        tau: torque, shape (n,), N m, finite and within the limits.
        a: accelerations that it is to give, shape (n,), rad/s^2.
        tracking: whether the tasks were served; False when the arm only holds still.
        relaxation: by how much the acceleration bounds had to give way to the torque limits,
            shape (n,), rad/s^2, or None.
        failure: why the QP was not used though it could have been, or empty.
    """

    tau: np.ndarray
    a: np.ndarray
    tracking: bool
    relaxation: np.ndarray | None = None
    failure: str = ""


class Controller:
    """Torques that move an arm towards its goals inside every limit.

    Args:
        robot: model of the arm.
        tau_max: torque limits, shape (n,), N m.
        gains: initial gains.
        torque_rate_max: greatest change of torque, shape (n,), N m/s; inf for none.
        additional: integral action; the torque limits hold with it counted in.
        solver: of the QP, one of `inverse_dynamics_qp.SOLVERS`.

    Attributes:
        q_des: joint goal, shape (n,), rad; None until one is set.
        pose_des: end-effector goal; None until one is set.
        error: error of the pose goal in the last step, shape (6,), m and rad.
        additional: as given.
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
    ) -> None:
        n = robot.n
        self.robot = robot
        self.tau_max = np.asarray(tau_max, dtype=float)
        self.gains = gains
        self.q_des: np.ndarray | None = None
        self.pose_des: pin.SE3 | None = None
        self._pose_motion: tuple[np.ndarray, np.ndarray] | None = None
        self._v_des: np.ndarray | None = None
        self.error = np.full(6, math.nan)
        self.iterations = 0
        rate = np.full(n, math.inf) if torque_rate_max is None else torque_rate_max
        self._tau_step = np.where(np.isinf(rate), np.inf, rate * robot.dt)
        self._rate_limited = bool(np.isfinite(rate).any())
        self._tau_min = -self.tau_max
        self.additional = additional
        self._qp = InverseDynamicsQP(n, solver=solver)
        self._observer = DisturbanceObserver(n, gains.disturbance_time)
        self._a_last = np.zeros(n)
        self._tau_last: np.ndarray | None = None
        self._posture = np.zeros(n)

    @property
    def has_goal(self) -> bool:
        """Whether there is something to track."""
        return self.pose_des is not None or self.q_des is not None

    def start(self, q: np.ndarray) -> None:
        """Forget the past; `q` becomes the posture that the null space is held at."""
        self._a_last = np.zeros(self.robot.n)
        self._tau_last = None
        self._observer.start()
        self._posture = q.copy()
        if self.additional is not None:
            self.additional.start()

    def set_pose_goal(
        self,
        pose_des: pin.SE3,
        twist: np.ndarray | None = None,
        twist_rate: np.ndarray | None = None,
    ) -> None:
        """Move the end effector to `pose_des` in the URDF's root frame.

        Args:
            pose_des: goal now.
            twist: of a goal in motion, in the goal's axes, shape (6,), m/s and rad/s; None for
                one at rest.
            twist_rate: time derivative of `twist`, shape (6,); with `twist`.
        """
        self.pose_des = pose_des
        self._pose_motion = None if twist is None else (twist, twist_rate)

    def set_posture_goal(self, q_des: np.ndarray, v_des: np.ndarray | None = None) -> None:
        """Bring the joints, or what the pose task leaves free of them, to `q_des`, rad.

        Args:
            q_des: goal now, shape (n,), rad.
            v_des: its velocity, shape (n,), rad/s; None for a goal at rest.
        """
        self.q_des = q_des
        self._v_des = v_des

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
        self.pose_des = None
        self.error.fill(math.nan)
        self.robot.rates = self.additional is not None
        self.robot.update(q, v, v)
        self.start(q)

    @property
    def acceleration(self) -> np.ndarray:
        """Acceleration commanded last, shape (n,), rad/s^2."""
        return self._a_last

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
        if not self.has_goal:
            return self.rest(q, v, a_lower, a_upper, elapsed)
        additional = self._begin(q, v, elapsed)
        return self._solve(q, v, self._tasks(q, v), a_lower, a_upper, additional, True)

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
        return self._solve(q, v, tasks, a_lower, a_upper, additional, False)

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
        goals = self.pose_des, self._pose_motion, self.q_des, self._v_des, self._posture
        self.start(q)
        self.robot.rates = self.additional is not None
        self.robot.update(q, v, self._a_last)
        self.set_posture_goal(q.copy())
        self.set_pose_goal(self.robot.pose.copy())
        step = self._solve(q, v, self._tasks(q, v), a_lower, a_upper, None, True)
        if not step.failure and not np.isfinite(tau).all():
            step = step._replace(failure="the torque of the motors is not finite")
        if step.failure:
            self.pose_des, self._pose_motion, self.q_des, self._v_des, self._posture = goals
            return step
        self._tau_last = np.clip(tau, self._tau_min, self.tau_max)
        if self.additional is not None:
            self.additional.seed(self.robot, v, self._tau_last - step.tau)
        return step

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
        if not robot.rates:
            return None
        return additional.torque(robot, v, self._a_last, elapsed)

    def _solve(
        self, q, v, tasks: list[TaskTerm], a_lower, a_upper, additional, tracking: bool
    ) -> Step:
        robot = self.robot
        bias = robot.h if additional is None else robot.h + additional
        lower, upper = self._torque_range()
        a_lower, a_upper = self._observer.shift(a_lower, a_upper)
        try:
            solution = self._qp.solve(tasks, a_lower, a_upper, robot.M, lower - bias, upper - bias)
        except NoSolutionFound as error:
            return self._hold(q, v, additional, str(error))
        self.iterations = solution.iterations
        tau = robot.torque(q, v, solution.a)
        if additional is not None:
            tau = tau + additional
        return Step(self._limited(tau), self._remember(solution.a), tracking, solution.relaxation)

    def hold(self, q: np.ndarray, v: np.ndarray, elapsed: float | None = None) -> Step:
        """Return a torque that needs no acceleration bounds: gravity and damping.

        Each joint brakes with `hold_kd`, as hard as its motor allows.
        """
        return self._hold(q, v, self._begin(q, v, elapsed), "")

    def _hold(self, q, v, additional, failure: str) -> Step:
        robot = self.robot
        self._observer.start()  # what is asked for here may be more than the motors can give
        a = -self.gains.hold_kd * v
        bias = robot.h
        if additional is not None and np.isfinite(additional).all():
            bias = robot.h + additional
        tau = robot.M @ a + bias
        sent = self._limited(tau)
        if not np.array_equal(sent, tau):
            # What the motors cannot give is no error for the integral to grow on.
            with suppress(np.linalg.LinAlgError):
                a = np.linalg.solve(robot.M, sent - bias)
        return Step(sent, self._remember(a), False, None, failure)

    def _tasks(self, q: np.ndarray, v: np.ndarray) -> list[TaskTerm]:
        gains = self.gains
        q_des = self._posture if self.q_des is None else self.q_des
        tasks = []
        if self.pose_des is not None:
            self.error = pose_error(self.robot.pose, self.pose_des)
            if gains.pose_weight > 0.0:
                tasks.append(
                    pose_task(
                        self.robot,
                        v,
                        self.error,
                        gains.pose_kp,
                        gains.pose_kd,
                        gains.pose_weight,
                        self._pose_ahead(v),
                    )
                )
        guarded = self.robot.J if tasks and gains.posture_in_null_space else None
        tasks.append(
            posture_task(
                q_des,
                q,
                v,
                gains.posture_kp,
                gains.posture_kd,
                gains.posture_weight,
                guarded,
                None if self._v_des is None else gains.posture_kd * self._v_des,
            )
        )
        return tasks

    def _pose_ahead(self, v: np.ndarray) -> np.ndarray | None:
        if self._pose_motion is None:
            return None
        return pose_feed_forward(
            self.robot, v, self.pose_des, *self._pose_motion, self.gains.pose_kd
        )

    def _torque_range(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the torques that may follow the last one, shape (n,) each, N m."""
        if self._tau_last is None or not self._rate_limited:
            return self._tau_min, self.tau_max
        return (
            np.maximum(self._tau_min, self._tau_last - self._tau_step),
            np.minimum(self.tau_max, self._tau_last + self._tau_step),
        )

    def _limited(self, tau: np.ndarray) -> np.ndarray:
        """Return `tau` as it may be sent: whatever came before, finite and within the limits."""
        if not math.isfinite(tau.dot(tau)):
            tau = np.zeros(self.robot.n) if self._tau_last is None else self._tau_last
        lower, upper = self._torque_range()
        self._tau_last = np.minimum(np.maximum(tau, lower), upper)
        return self._tau_last

    def _remember(self, a: np.ndarray) -> np.ndarray:
        self._a_last = a if math.isfinite(a.dot(a)) else np.zeros(self.robot.n)
        return self._a_last
