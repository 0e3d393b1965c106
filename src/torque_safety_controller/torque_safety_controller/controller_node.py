"""The controller node: joint states, acceleration limits and goals in, joint torques out."""

from __future__ import annotations

import sys
import time
from array import array
from collections import deque
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from trajectory_msgs.msg import JointTrajectory

from torque_safety_controller.controller import Controller, Step
from torque_safety_controller.controller_parameters import (
    TABLE,
    ControllerConfiguration,
    load_robot,
    make_configuration,
)
from torque_safety_controller.modes import Mode, ModeKeeper
from torque_safety_controller.ros_goals import (
    GoalQueue,
    GoalRefused,
    pose_from_message,
    posture_from_message,
)
from torque_safety_controller.ros_limits import LimitsReader
from viability_bounds_pkg.ros_messages import Diagnostics, JointStateReader, Verdict
from viability_bounds_pkg.ros_parameters import NodeParameters, ParameterError
from viability_bounds_pkg.ros_runtime import CONTROL_QOS, GOAL_QOS, run

_LATENCIES_KEPT = 4096


class ControllerNode(Node):
    """Answers each joint state, once its acceleration limits are there, with torques.

    Subscribes to ``joint_states``, ``acceleration_limits``, ``target_pose`` and
    ``target_posture``; publishes ``joint_commands`` with the stamp of the state answered.
    """

    def __init__(self, **node_arguments: Any) -> None:
        super().__init__("controller_node", **node_arguments)
        try:
            self._node_parameters = NodeParameters(
                self, TABLE, make_configuration, self._configure
            )
            robot, self._base = load_robot(self._node_parameters.values, self)
        except ParameterError:
            self.destroy_node()
            raise
        config = self._config = self._node_parameters.configuration
        self._controller = Controller(robot, config.tau_max, config.gains, config.tau_rate_max)
        self._controller.warm_up()
        self._states = JointStateReader(config.joints, config.state_timeout)
        self._limits = LimitsReader(config.joints)
        self._goals = GoalQueue()
        self._modes = ModeKeeper()
        self._goal_at = time.monotonic()
        self._message_at = self._state_at = self._waiting_since = -np.inf
        self._message_stamp = None
        self._answered_stamp = -1
        self._bounds_lost = False
        self._steps = self._relaxed_steps = self._failures = 0
        self._latencies: deque[float] = deque(maxlen=_LATENCIES_KEPT)
        self._last_relaxation = np.zeros(len(config.joints))

        self._command = JointState(name=list(config.joints))
        self._publisher = self.create_publisher(JointState, "joint_commands", CONTROL_QOS)
        self._efforts = None
        if config.ros2_control_topic:
            self._efforts = self.create_publisher(
                Float64MultiArray, config.ros2_control_topic, CONTROL_QOS
            )
        self.create_subscription(JointState, "joint_states", self._on_state, CONTROL_QOS)
        self.create_subscription(
            JointTrajectory, "acceleration_limits", self._on_limits, CONTROL_QOS
        )
        self.create_subscription(PoseStamped, "target_pose", self._on_pose, GOAL_QOS)
        self.create_subscription(JointState, "target_posture", self._on_posture, GOAL_QOS)
        # Watchdogs must bark when time itself, as the clock topic tells it, stands still.
        self._watchdog = self.create_timer(
            min(config.bounds_timeout, config.state_timeout) / 4,
            self._watch,
            clock=Clock(clock_type=ClockType.STEADY_TIME),
        )
        self._diagnostics = Diagnostics(self, self._report)

    def _configure(self, config: ControllerConfiguration) -> None:
        self._config = config
        self._controller.gains = config.gains

    # Streams

    def _on_state(self, message: JointState) -> None:
        now = time.monotonic()
        self._message_at, self._message_stamp = now, message.header.stamp
        last = self._states.stamp
        verdict = self._states.read(message, now)
        if verdict is Verdict.REFUSED:
            return
        silent = now - self._state_at > self._config.state_timeout
        self._state_at = now
        if silent or (verdict is Verdict.NEW and self._states.stamp <= last):
            self._begin(verdict)
        elif verdict is Verdict.REPEAT:
            if self._answered_stamp == last:
                self._send(message.header.stamp)
            return
        elif self._answered_stamp == last:
            self._waiting_since = now
        if self._limits.stamp == self._states.stamp:
            self._track(message.header.stamp)
        elif self._bounds_lost:
            self._answer(
                self._controller.hold(self._states.q, self._states.v), message.header.stamp
            )

    def _begin(self, verdict: Verdict) -> None:
        """Forget the past: the robot was silent, or started over."""
        if verdict is Verdict.NEW and self._limits.stamp == self._answered_stamp:
            self._limits.stamp = -1  # of another run, in which stamps may have been the same
        self._answered_stamp = -1
        self._waiting_since = self._state_at
        self._controller.start(self._states.q)

    def _on_limits(self, message: JointTrajectory) -> None:
        if not self._limits.read(message):
            return
        if self._limits.stamp == self._states.stamp != self._answered_stamp:
            self._track(message.header.stamp)
        elif self._limits.stamp == self._states.stamp:
            # They are alive again, but this state was answered in HOLD already.
            self._bounds_lost = False

    def _track(self, stamp: Any) -> None:
        """Answer the newest state, whose acceleration limits are there."""
        self._bounds_lost = False
        if self._goals.apply_due(self._states.stamp):
            self._goal_at = time.monotonic()
        states, limits = self._states, self._limits
        if self._goal_lost():
            step = self._controller.rest(states.q, states.v, limits.lower, limits.upper)
        else:
            step = self._controller.step(states.q, states.v, limits.lower, limits.upper)
        self._steps += 1
        if step.relaxation is not None:
            self._relaxed_steps += 1
            self._last_relaxation = step.relaxation
        self._answer(step, stamp)

    def _goal_lost(self) -> bool:
        timeout = self._config.goal_timeout
        return timeout > 0.0 and time.monotonic() - self._goal_at > timeout

    def _answer(self, step: Step, stamp: Any) -> None:
        """Publish the torques of `step` for the state with `stamp`."""
        now = time.monotonic()
        self._command.effort = array("d", step.tau.tobytes())
        self._send(stamp)
        self._answered_stamp = self._states.stamp
        self._latencies.append(now - self._message_at)
        if step.failure:
            self._failures += 1
        if step.tracking:
            self._enter(Mode.TRACKING, "goal")
        else:
            self._enter(Mode.HOLD, self._why_hold(step))

    def _why_hold(self, step: Step) -> str:
        if step.failure:
            return f"solver failed: {step.failure}"
        if self._bounds_lost:
            return "acceleration limits are stale"
        if self._controller.has_goal:
            return "goal lost"
        return "no goal"

    def _send(self, stamp: Any) -> None:
        self._command.header.stamp = stamp
        self._publisher.publish(self._command)
        if self._efforts is not None:
            self._efforts.publish(Float64MultiArray(data=self._command.effort))

    # Watchdogs

    def _watch(self) -> None:
        now = time.monotonic()
        config = self._config
        if now - self._state_at > config.state_timeout:
            if self._modes.mode is not Mode.STOPPED:
                quiet = now - self._message_at > config.state_timeout
                self._enter(Mode.STOPPED, "no joint state" if quiet else self._why_refused())
            return
        waiting = self._states.stamp != self._answered_stamp
        if waiting and now - self._waiting_since > config.bounds_timeout:
            self._bounds_lost = True
            self._answer(
                self._controller.hold(self._states.q, self._states.v), self._message_stamp
            )
        elif (
            now - self._state_at > config.bounds_timeout
            and now - self._message_at < config.bounds_timeout
        ):
            # States come but cannot be used: keep gravity off the arm until STOPPED.
            step = self._controller.hold(self._states.q, np.zeros_like(self._states.v))
            self._command.effort = array("d", step.tau.tobytes())
            self._send(self._message_stamp)
            self._enter(Mode.HOLD, self._why_refused())

    def _why_refused(self) -> str:
        return "joint states are refused: " + ", ".join(self._states.refused)

    def _enter(self, mode: Mode, reason: str) -> None:
        if not self._modes.set(mode, reason):
            return
        text = f"{mode.value}: {reason}"
        # One call site per severity: rclpy ties the two together.
        if mode is Mode.TRACKING:
            self.get_logger().info(text)
        else:
            self.get_logger().warning(text)
        self._diagnostics.publish()

    # Goals

    def _on_pose(self, message: PoseStamped) -> None:
        try:
            pose = pose_from_message(message, self._config.base_frame)
        except GoalRefused as error:
            return self._refuse_goal("target_pose", error)
        self._goals.add(message, lambda: self._controller.set_pose_goal(self._base * pose))

    def _on_posture(self, message: JointState) -> None:
        config = self._config
        try:
            q_des = posture_from_message(message, config.joints, config.q_min, config.q_max)
        except GoalRefused as error:
            return self._refuse_goal("target_posture", error)
        self._goals.add(message, lambda: self._controller.set_posture_goal(q_des))

    def _refuse_goal(self, topic: str, error: GoalRefused) -> None:
        self._goals.refused[topic] += 1
        self.get_logger().warning(f"{topic} refused: {error}")

    # Diagnostics

    def _report(self) -> tuple[bytes, str, dict[str, Any]]:
        controller, modes = self._controller, self._modes
        latencies = np.array(self._latencies) if self._latencies else np.full(1, np.nan)
        median, slow = np.percentile(latencies, (50, 99)) * 1e6
        values = {
            "mode": modes.mode.value,
            "reason": modes.reason,
            "mode_changes": modes.changes,
            "steps": self._steps,
            "position_error_m": float(np.linalg.norm(controller.error[:3])),
            "orientation_error_rad": float(np.linalg.norm(controller.error[3:])),
            "goals_pending": len(self._goals),
            "goals_refused": self._goals.refused,
            "states_refused": self._states.refused,
            "limits_refused": self._limits.refused,
            "qp_iterations": controller.iterations,
            "qp_failures": self._failures,
            "bounds_relaxed_steps": self._relaxed_steps,
            "bounds_last_relaxation_rad_s2": self._last_relaxation,
            "joints_at_acceleration_limit": ", ".join(self._joints_at_limit()) or "none",
            "latency_p50_us": float(median),
            "latency_p99_us": float(slow),
        }
        level = {
            Mode.TRACKING: DiagnosticStatus.OK,
            Mode.HOLD: DiagnosticStatus.WARN,
            Mode.STOPPED: DiagnosticStatus.ERROR,
        }[modes.mode]
        return level, f"{modes.mode.value}: {modes.reason}", values

    def _joints_at_limit(self) -> list[str]:
        a, limits = self._controller.acceleration, self._limits
        near = 1e-3 * (limits.upper - limits.lower) + 1e-6
        at = (a <= limits.lower + near) | (a >= limits.upper - near)
        return [name for name, flag in zip(self._config.joints, at, strict=True) if flag]


def main(args: list[str] | None = None) -> int:
    """Run the controller node until it is told to stop."""
    return run(ControllerNode, args)


if __name__ == "__main__":
    sys.exit(main())
