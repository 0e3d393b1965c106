# SPDX-License-Identifier: Apache-2.0
"""The controller node: joint states, acceleration limits and goals in, joint torques out."""

from __future__ import annotations

import sys
import time
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.clock import Clock, ClockType
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool
from trajectory_msgs.msg import JointTrajectory

from torque_safety_controller.controller import ControlOutput
from torque_safety_controller.node.assembly import (
    configure,
    make_controller,
    make_state_check,
)
from torque_safety_controller.node.collision_report import CollisionReport
from torque_safety_controller.node.controller_report import (
    LEVELS,
    StepRecord,
    about_detour,
    too_weak,
)
from torque_safety_controller.node.declared import covered_row, declared_robot
from torque_safety_controller.node.gain_watch import GainWatch
from torque_safety_controller.node.goals import GoalSubscriber
from torque_safety_controller.node.joint_commands import JointCommands
from torque_safety_controller.node.limits import LimitsReader
from torque_safety_controller.node.state_publisher import StatePublisher
from torque_safety_controller.node.topics import ENABLE_TORQUE, GOALS
from torque_safety_controller.node.wrenches import WrenchSubscriber
from torque_safety_controller.parameters.controller_parameters import ControllerConfiguration
from torque_safety_controller.qp.constraints import AccelerationRange
from torque_safety_controller.safety.handover import Control, Handover, HandoverRefused
from torque_safety_controller.safety.modes import Mode, ModeKeeper
from torque_safety_controller.safety.rate_watch import RateWatch
from viability_bounds_pkg.ros.arm_node import ArmNode
from viability_bounds_pkg.ros.messages import Diagnostics, JointStateReader, PeriodCheck, Verdict
from viability_bounds_pkg.ros.parameters import NodeParameters
from viability_bounds_pkg.ros.program import run
from viability_bounds_pkg.ros.publisher_watch import PublisherWatch
from viability_bounds_pkg.ros.robot_urdf import DescriptionWatch
from viability_bounds_pkg.ros.topics import (
    ACCELERATION_LIMITS,
    FT_WRENCH,
    JOINT_COMMANDS,
    state_topic,
)
from viability_bounds_pkg.state import State
from viability_bounds_pkg.state_estimation.state_check import RESTART, STAYS

_STALE = "acceleration limits are stale"
_CONTESTED = "several nodes publish goals"
_UNSEEN = 3
"""At which joint state in a row that cannot be used the mode is STOPPED."""


class ControllerNode(ArmNode):
    """Answers each joint state, once its acceleration limits are there, with torques.

    Subscribes to ``joint_states`` or ``estimated_joint_states``, to ``acceleration_limits`` and
    goals; publishes ``joint_commands`` with the stamp of the state answered. The service
    ``~/enable_torque`` hands over between the robot's position control and torque.
    """

    NAME = "controller_node"
    PARAMETERS = ControllerConfiguration

    def __init__(self, **node_arguments: Any) -> None:
        self._gains: GainWatch | None = None
        super().__init__(**node_arguments)
        with self.starting(JOINT_COMMANDS):
            self._node_parameters = NodeParameters(self, ControllerConfiguration, self._configure)
            config = self._node_parameters.configuration
            self._controller, base = make_controller(config, self)
        self._config = config
        self._handover = Handover(
            config.start_control,
            config.joints,
            config.position_min,
            config.position_max,
            config.torque_max,
            config.dt,
        )
        check = make_state_check(config, self._controller.robot.model, declared_robot(self))
        self._states = JointStateReader(config.joints, config.state_timeout, self._warn, check)
        self._period = PeriodCheck(config.dt, self._warn)
        self._limits = LimitsReader(config.joints, self._warn)
        states = state_topic(config.use_estimated_states)
        alone = JOINT_COMMANDS, states, ACCELERATION_LIMITS, FT_WRENCH, *GOALS
        self.publisher_watch = PublisherWatch(
            self,
            filter(None, [*(topic.name for topic in alone), config.ros2_control_topic]),
            needs_estimates=config.use_estimated_states,
        )
        heard = self, self.publisher_watch
        self._goals = GoalSubscriber(*heard, self._controller, config, base)
        self._wrenches = WrenchSubscriber(
            *heard, self._controller.interaction, self._goals, config, base
        )
        self._modes = ModeKeeper()
        self._goal_at = time.monotonic()
        self._message_at = self._state_at = self._waiting_since = -np.inf
        self._message_stamp = None
        self._answered_stamp = -1
        self._refused_in_row = 0
        self._bounds_lost = False
        self._went_wrong = ""  # why the arm was braked, until it goes on
        self._rate = RateWatch(config.dt, covered_row(self))
        self._record = StepRecord(len(config.joints))
        self._collision = CollisionReport(self.get_logger(), self._controller.constraints)

        self._commands = JointCommands(self, config.joints, config.ros2_control_topic)
        self._gains = GainWatch(self, self._controller.robot.model, config)
        self._published = StatePublisher(self, self._controller, config, base, self._states)
        self._states_topic = states.subscription(self, self._on_state).topic_name
        limits = ACCELERATION_LIMITS.subscription(self, self._on_limits)
        self._limits_topic = limits.topic_name
        ENABLE_TORQUE.serve(self, self._on_enable_torque)
        # Use the steady clock, so that watchdogs fire when /clock stops.
        self._watchdog = self.create_timer(
            min(config.bounds_timeout, config.state_timeout) / 4,
            self._watch,
            clock=Clock(clock_type=ClockType.STEADY_TIME),
        )
        self._diagnostics = Diagnostics(
            self, self._report, self.publisher_watch, DescriptionWatch(self)
        )
        if config.collision.bodies and not config.collision.collision_avoidance:
            self.get_logger().warning(
                "parameter 'obstacles' is given, but 'collision_avoidance' is false: the arm does "
                "not avoid them"
            )
        avoiding = "with" if config.collision.collision_avoidance else "without"
        self.announce(
            config.joints,
            config.rate_hz,
            f"{config.start_control} control, integral action {config.integral.integral_action}, "
            f"{avoiding} collision avoidance",
        )

    def destroy_node(self) -> None:
        """End what runs beside the callbacks, too."""
        if self._gains is not None:  # else the start failed
            self._gains.close()
        super().destroy_node()

    def _configure(self, config: ControllerConfiguration) -> None:
        self._config = config
        configure(self._controller, config)
        if self._gains is not None:
            self._gains.look(config)

    def _warn(self, text: str) -> None:
        self.get_logger().warning(text)

    # Streams

    def _on_state(self, message: JointState) -> None:
        if not self.publisher_watch.admits(self._states_topic):
            return
        now = time.monotonic()
        self._message_at, self._message_stamp = now, message.header.stamp
        last, was_at = self._states.stamp, self._states.q
        verdict = self._states.read(message, now)
        if verdict is Verdict.REFUSED:
            self._on_refused(message.header.stamp)
            return
        self._refused_in_row = 0
        silent = now - self._state_at > self._config.state_timeout
        self._state_at = now
        if silent and 0 <= self._answered_stamp <= last < self._states.stamp:
            self._went_wrong = "joint states were missing"
        # Where the time alone has leapt, the arm goes on without a jolt.
        elsewhere = self._states.stamp - last >= 1e9 * RESTART and bool(
            (np.abs(self._states.q - was_at) > STAYS).any()
        )
        if silent or (verdict is Verdict.NEW and (self._states.stamp <= last or elsewhere)):
            self._begin(verdict)
        elif verdict is Verdict.REPEAT:
            if self._answered_stamp == last:
                self._commands.again(message.header.stamp)
            return
        elif self._answered_stamp == last:
            self._waiting_since = now
        if self._handover.control is Control.POSITION:
            self._hold_position(message.header.stamp)
        elif self._limits.stamp == self._states.stamp:
            self._track(message.header.stamp)
        elif self._bounds_lost:
            self._hold(message.header.stamp)

    def _on_refused(self, stamp: Any) -> None:
        """Leave the arm to the robot's own stop, or to its drives: nothing is known of it."""
        if self._answered_stamp < 0 or self._modes.mode is Mode.STOPPED:
            return
        self._refused_in_row += 1
        if self._handover.by_drives:
            self._hold_position(stamp)
        elif self._refused_in_row == _UNSEEN:
            self._went_wrong = self._why_refused()
            self._enter(Mode.STOPPED, self._went_wrong)

    def _begin(self, verdict: Verdict) -> None:
        """Start anew: the robot was silent, or restarted."""
        if verdict is Verdict.NEW and self._limits.stamp == self._answered_stamp:
            self._limits.stamp = -1  # from before the restart; its stamps may come again
        self._answered_stamp = -1
        self._waiting_since = self._state_at
        self._controller.reset(self._states.q)
        self._handover.robot_was_away()

    def _on_limits(self, message: JointTrajectory) -> None:
        if not (self.publisher_watch.admits(self._limits_topic) and self._limits.read(message)):
            return
        if self._limits.stamp == self._states.stamp != self._answered_stamp:
            self._track(message.header.stamp)
        elif self._limits.stamp == self._states.stamp:
            # Limits come again, but this state has been answered in HOLD already.
            self._bounds_lost = False

    def _track(self, stamp: Any) -> None:
        """Answer the newest state, whose acceleration limits are there."""
        self._bounds_lost = False
        if self._handover.by_drives:
            self._hold_position(stamp)
            if self._handover.control is Control.TAKING_OVER:
                self._take_over()
            return
        if self._goals.apply_due(self._states.stamp):
            self._goal_at = time.monotonic()
        contested = self._goals.contested
        if contested:
            self._went_wrong = _CONTESTED
        elif self._went_wrong:
            self._rate.slow(self._went_wrong)
            self._went_wrong = ""
        self._note_rate()
        now = State(self._states.q, self._states.v), self._bounds()
        lost = contested or self._goal_lost()
        if lost or self._handover.control is Control.GIVING_BACK:
            step = self._controller.brake(*now, self._elapsed())
        else:
            step = self._controller.step(*now, self._elapsed())
        self._answer(step, stamp)

    def _elapsed(self) -> float | None:
        """Return the time since the state answered last, s; None if there is none."""
        if self._answered_stamp < 0:
            return None
        return 1e-9 * (self._states.stamp - self._answered_stamp)

    def _note_rate(self) -> None:
        """Slow the arm if too many states were not answered."""
        if news := self._rate.note(self._elapsed()):
            self._warn(news)
        self._controller.share = self._rate.share

    def _bounds(self) -> AccelerationRange:
        return AccelerationRange(self._limits.lower, self._limits.upper)

    def _goal_lost(self) -> bool:
        timeout = self._config.goal_timeout
        return timeout > 0.0 and time.monotonic() - self._goal_at > timeout

    def _answer(self, step: ControlOutput, stamp: Any) -> None:
        """Publish the torques of `step` for the state with `stamp`."""
        now = time.monotonic()
        elapsed = self._elapsed() or 0.0
        self._commands.torque(step.tau, stamp)
        self._answered_stamp = self._states.stamp
        self._record.note(step, now - self._message_at)
        self._wrenches.note()
        self._collision.note(step)
        self._went_wrong = self._went_wrong or step.failure
        if step.tracking:
            self._enter(Mode.TRACKING, "goal")
        else:
            self._enter(Mode.HOLD, self._why_hold(step))
        if self._handover.control is Control.GIVING_BACK:
            self._handover.slow_down(self._states.q, self._states.v, elapsed)

    def _why_hold(self, step: ControlOutput) -> str:
        if step.failure:
            return f"solver failed: {step.failure}"
        if self._bounds_lost:
            return _STALE
        if self._handover.control is Control.GIVING_BACK:
            return "on the way to position control"
        if self._controller.lost:
            return "no plan within all limits is known"
        if self._goals.contested:
            return _CONTESTED
        return "goal lost" if self._goal_lost() else "no goal"

    def _hold(self, stamp: Any) -> None:
        """Answer the newest state without acceleration limits."""
        self._went_wrong = _STALE
        self._note_rate()
        state = State(self._states.q, self._states.v)
        self._answer(self._controller.hold(state, self._elapsed()), stamp)

    # Position control

    def _hold_position(self, stamp: Any) -> None:
        """Answer the newest state with the position that the drives hold."""
        self._commands.position(self._handover.hold(self._states.q), stamp)
        self._answered_stamp = self._states.stamp
        self._enter(Mode.POSITION, self._handover.reason)

    def _take_over(self) -> None:
        """Prepare to go on with torque from the next state; this one is still the drives'.

        Not before the torque of the motors is known.
        """
        states = self._states
        if self._goals.apply_due(states.stamp):
            self.get_logger().warning("goals from before the handover are dropped")
        try:
            tau = self._handover.average(states.q, states.effort())
        except HandoverRefused as error:
            self._fail_handover(str(error))
            return
        if tau is None:
            return
        state = State(states.q, states.v)
        step = self._controller.bumpless_transfer(state, self._bounds(), tau)
        if step.failure:
            self._fail_handover(f"solver failed: {step.failure}")
            return
        self._goal_at = time.monotonic()
        self._handover.taken_over()
        found = self._handover.torque
        self.get_logger().info(
            f"torque of the motors at the handover: from {found.samples} states, off by at most "
            f"{found.error.max():.2%} of torque_max"
        )

    def _fail_handover(self, reason: str) -> None:
        self._handover.failed(reason)
        self.get_logger().error(self._handover.reason)
        self._enter(Mode.POSITION, self._handover.reason)

    def _on_enable_torque(
        self, request: SetBool.Request, response: SetBool.Response
    ) -> SetBool.Response:
        """Start a handover, or say why not."""
        states, config, silence = self._states, self._config, time.monotonic() - self._state_at
        try:
            if request.data:
                # After a restart of the robot, earlier limits may have later stamps.
                apart = 1e-9 * abs(states.stamp - self._limits.stamp)
                bounds_fresh = self._limits.stamp >= 0 and apart <= config.bounds_timeout
                fresh = silence < config.bounds_timeout
                self._handover.to_torque(states.q, states.effort(), fresh, bounds_fresh)
                self._bounds_lost = False
                response.message = "torque control begins when the torque of the motors is known"
            else:
                self._handover.to_position(states.q, states.v, silence < config.state_timeout)
                response.message = "position control begins when the arm is at rest"
            response.success = True
        except HandoverRefused as error:
            response.message = str(error)
            self.get_logger().warning(f"enable_torque refused: {error}")
        return response

    # Watchdogs

    def _watch(self) -> None:
        now = time.monotonic()
        config = self._config
        if now - self._state_at > config.state_timeout:
            if self._modes.mode is not Mode.STOPPED:
                quiet = now - self._message_at > config.state_timeout
                silent = self.publisher_watch.several or "no joint state"
                self._enter(Mode.STOPPED, silent if quiet else self._why_refused())
            return
        waiting = self._states.stamp != self._answered_stamp and not self._refused_in_row
        if waiting and now - self._waiting_since > config.bounds_timeout:
            self._bounds_lost = True
            if self._handover.control is Control.TAKING_OVER:
                self._fail_handover(_STALE)
            if self._handover.by_drives:
                self._hold_position(self._message_stamp)
            else:
                self._hold(self._message_stamp)

    def _why_refused(self) -> str:
        return "joint states are refused: " + ", ".join(self._states.refused)

    def _enter(self, mode: Mode, reason: str) -> None:
        before = self._modes.mode
        if not self._modes.set(mode, reason):
            return
        if mode is not before:
            self._published.mode(mode)
        text = f"{mode.value}: {reason}"
        # One call site per severity: rclpy ties the two together.
        if mode in (Mode.TRACKING, Mode.POSITION):
            self.get_logger().info(text)
        else:
            self.get_logger().warning(text)
        self._diagnostics.publish()

    # Diagnostics

    def _report(self) -> tuple[bytes, str, dict[str, Any]]:
        self._period.look(self._states)
        values = self._record.values(
            self._config.joints, self._controller, self._limits.lower, self._limits.upper
        )
        values |= (
            self._collision.values()
            | self._wrenches.values()
            | {
                "mode": self._modes.mode.value,
                "reason": self._modes.reason,
                "mode_changes": self._modes.changes,
                "control": self._handover.control.value,
                "integral_action": self._config.integral.integral_action,
                "goal_share": self._rate.share,
                "missed_rows_too_long": self._rate.too_long,
                "missed_row_longest": self._rate.longest,
                "goals_pending": len(self._goals),
                "goals_refused": self._goals.refused,
                "states_refused": self._states.refused,
                "limits_refused": self._limits.refused,
            }
        )
        level, text = LEVELS[self._modes.mode], f"{self._modes.mode.value}: {self._modes.reason}"
        weak = too_weak(self._config.joints, self._controller)
        weak = weak and f"the arm cannot be held where it would come to rest: {weak}"
        troubles = self._rate.trouble, self._collision.too_near, self._wrenches.trouble, weak
        for trouble in filter(None, troubles):
            level, text = max(level, DiagnosticStatus.WARN), f"{text}; {trouble}"
        detour = about_detour(self._config.joints, self._controller)
        if detour.text:
            level, text = max(level, detour.level), f"{text}; {detour.text}"
        return level, text, values


def main(args: list[str] | None = None) -> int:
    """Run the controller node until it is told to stop."""
    return run(ControllerNode, args)


if __name__ == "__main__":
    sys.exit(main())
