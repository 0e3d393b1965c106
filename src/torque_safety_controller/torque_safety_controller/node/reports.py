# SPDX-License-Identifier: Apache-2.0
"""What the controller node reports: diagnostics, the pose of the hand, the mode."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Any

import numpy as np
import pinocchio as pin
from diagnostic_msgs.msg import DiagnosticStatus
from numpy.typing import NDArray
from rclpy.node import Node
from std_msgs.msg import String

from torque_safety_controller.controller import Controller
from torque_safety_controller.modes import Mode
from torque_safety_controller.node.goals import GoalSubscriber
from torque_safety_controller.node.periodic import StateStream
from torque_safety_controller.node.topics import CONTROLLER_MODE, HAND_POSE
from torque_safety_controller.parameters.controller_parameters import ControllerConfiguration
from torque_safety_controller.parts.collision.avoidance import Collision
from torque_safety_controller.robot_model import RobotModel
from torque_safety_controller.step import Step, joints_named
from torque_safety_controller.supervisor import Supervisor
from viability_bounds_pkg.recent_values import RecentValues
from viability_bounds_pkg.robot.description import frame_id
from viability_bounds_pkg.ros.messages import JointStateReader, PeriodCheck, pose_message
from viability_bounds_pkg.ros.runtime import steady_timer

Array = NDArray[np.float64]

LEVELS = {
    Mode.TRACKING: DiagnosticStatus.OK,
    Mode.POSITION: DiagnosticStatus.OK,
    Mode.HOLD: DiagnosticStatus.WARN,
    Mode.STOPPED: DiagnosticStatus.ERROR,
}

_PERIOD = 0.05  # s; between messages of the hand's pose
_SLIGHT = 1e-3  # rad/s^2; smaller relaxations of bounds come with those of distances

_STANDS = 1.0
"""How long the arm stands before it is told, s."""

_PROGRESS = np.array([1e-3, 5e-3])
"""By how much it must come nearer meanwhile, m and rad; an arm may shake where it stands."""

_NEAR = 0.01
"""Distance at which a joint is on a position limit, rad."""

_SHORT = np.array([0.005, 0.02])
"""What counts as short of the goal, m and rad."""


class ControllerReport:
    """Diagnostics of the controller node.

    Args:
        node: logs.
        config: of the arm; only what does not change while the node runs is used.
        controller: of the arm.
        supervisor: has mode, reason and share.
        states: as they come.
        refused: what was refused, by kind and reason.
        goals: that wait for their time.
    """

    def __init__(
        self,
        node: Node,
        config: ControllerConfiguration,
        controller: Controller,
        supervisor: Supervisor,
        states: StateStream,
        refused: Mapping[str, Counter[str]],
        goals: GoalSubscriber,
    ) -> None:
        self._controller, self._supervisor, self._states = controller, supervisor, states
        self._refused, self._goals = refused, goals
        self._fixed = {
            "integral_action": config.integral.integral_action,
            "torque_rate_max": "clipped" if config.clips_torque_rates else "none",
        }
        if collision := controller.find(Collision):
            logger, margin = node.get_logger(), collision.margin
            pairs = len(collision.model.names)
            logger.info(f"collision avoidance keeps {pairs} pairs of shapes {margin:g} m apart")
            for where, names in collision.model.left_out.items():
                apart = ", ".join(sorted(set(names)))
                logger.warning(f"not kept apart, as near each other in {where}: {apart}")
        self._shortfall = Shortfall(config.position_min, config.position_max)
        self._period = PeriodCheck(config.dt, node.get_logger().warning)
        self._steps = self._relaxed_steps = self._failures = 0
        self._latencies = RecentValues()
        self._last_relaxation = np.zeros(len(config.joints))
        self._last: Step | None = None

    def add(self, step: Step, latency: float) -> None:
        """Count a step that was answered `latency` seconds after its state came."""
        self._latencies.add(latency)
        self._last = step
        self._steps += 1
        self._failures += bool(step.failure)
        if step.relaxation is not None and step.relaxation.max() > _SLIGHT:
            self._relaxed_steps += 1
            self._last_relaxation = step.relaxation

    def __call__(self) -> tuple[bytes, str, dict[str, Any]]:
        """Return level, message and values of the node's status."""
        self._period.compare(self._states)
        supervisor, controller = self._supervisor, self._controller
        mode = supervisor.mode
        level, text = LEVELS[mode], f"{mode.value}: {supervisor.reason}"
        if due := self._goals.due:
            text = f"{text}; {due}"
        troubles = supervisor.trouble, *(part.trouble for part in controller.parts)
        for trouble in filter(None, troubles):
            level, text = max(level, DiagnosticStatus.WARN), f"{text}; {trouble}"
        short = self._shortfall.text(controller, 1e-9 * self._states.stamp)
        if mode is not Mode.TRACKING:
            short = ""
        values = self._values() | {"short_of_goal": short or "none"}
        return level, f"{text}; {short}" if short else text, values

    def _values(self) -> dict[str, Any]:
        values: dict[str, Any] = {
            "steps": self._steps,
            "qp_failures": self._failures,
            "bounds_relaxed_steps": self._relaxed_steps,
            "bounds_last_relaxation_rad_s2": self._last_relaxation,
            "latency_p50_us": 1e6 * self._latencies.percentile(50),
            "latency_p99_us": 1e6 * self._latencies.percentile(99),
            "goals_pending": len(self._goals.waiting),
            "payload": str(self._controller.robot.payload),
        }
        for more in (self._fixed, self._refused, self._supervisor.values()):
            values |= more
        values |= self._controller.report()
        return values if self._last is None else values | self._of_step(self._last)

    def _of_step(self, step: Step) -> dict[str, Any]:
        """Return values of the last step."""
        robot, (lower, upper) = step.robot, step.commanded(step.bounds)
        error = self._controller.goals.error(robot.pose)
        near = 1e-3 * (upper - lower) + 1e-6
        at_limit = (step.a <= lower + near) | (step.a >= upper - near)
        return {
            "position_error_m": float(np.linalg.norm(error[:3])),
            "orientation_error_rad": float(np.linalg.norm(error[3:])),
            "qp_iterations": 0 if step.solution is None else step.solution.iterations,
            "joints_at_acceleration_limit": joints_named(robot, at_limit),
            "additional_torque_nm": step.torque,
        }


class Shortfall:
    """Tells that the arm stands short of a pose that stays the goal.

    Args:
        q_min: lower position limits, shape (n,), rad.
        q_max: upper ones, shape (n,), rad.
    """

    def __init__(self, q_min: np.ndarray, q_max: np.ndarray) -> None:
        self._q_min, self._q_max = q_min, q_max
        self._goal: pin.SE3 | None = None
        self._since = 0.0
        self._least = np.zeros(2)

    def text(self, controller: Controller, now: float) -> str:
        """Return by how much, once it has come no nearer for `_STANDS`; else nothing.

        Args:
            controller: of the arm.
            now: the robot's time, s.
        """
        goal, robot = controller.goals.pose_des, controller.robot
        if goal is None:
            self._goal = None
            return ""
        error = controller.goals.error(robot.pose)
        left = np.array([np.linalg.norm(part) for part in np.split(error, 2)])
        if self._goal is None or goal != self._goal or now < self._since:
            self._goal, self._since, self._least = goal.copy(), now, left
        elif (self._least - left > _PROGRESS).any():
            self._since, self._least = now, np.minimum(left, self._least)
        if now - self._since < _STANDS or (left < _SHORT).all():
            return ""
        near = np.minimum(robot.q - self._q_min, self._q_max - robot.q) < _NEAR
        text = f"stands {1e3 * left[0]:.0f} mm and {left[1]:.2f} rad short of its goal"
        return text + (f", on limits of {joints_named(robot, near)}" if near.any() else "")


class StatePublisher:
    """Publishes the pose of the hand, by a timer of its own, and the mode.

    Control steps do no work for it, and what has no subscriber costs nothing. The pose is computed
    from the last joint state here, so that it is there in all modes.

    Args:
        node: publishes.
        robot: model of the arm.
        config: names the base frame.
        base: placement of the base frame in the URDF's root frame.
        states: has the last joint state.
    """

    def __init__(
        self,
        node: Node,
        robot: RobotModel,
        config: ControllerConfiguration,
        base: pin.SE3,
        states: JointStateReader,
    ) -> None:
        self._states = states
        self._base_frame, self._base = config.base_frame, base
        self._model, self._data = robot.model, robot.model.createData()
        self._frame = frame_id(robot.model, robot.frame)
        self._pose = HAND_POSE.publisher(node)
        self._mode = CONTROLLER_MODE.publisher(node)
        self._last: Mode | None = None
        self.mode(Mode.STOPPED)
        steady_timer(node, _PERIOD, self._publish)

    def mode(self, mode: Mode) -> None:
        """Publish the mode if it is new; ``hand_pose`` is silent while it is STOPPED."""
        if mode is not self._last:
            self._last = mode
            self._mode.publish(String(data=mode.value))

    def _publish(self) -> None:
        if self._last is Mode.STOPPED or not self._pose.get_subscription_count():
            return
        pin.forwardKinematics(self._model, self._data, self._states.q)
        pose = self._base.actInv(pin.updateFramePlacement(self._model, self._data, self._frame))
        self._pose.publish(pose_message(pose, self._base_frame, self._states.stamp))
