# SPDX-License-Identifier: Apache-2.0
"""The controller node: joint states, acceleration limits and goals in, joint torques out."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from functools import partial
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.clock import Clock, ClockType
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory

from torque_safety_controller.controller import ControlOutput
from torque_safety_controller.node.assembly import (
    configure,
    make_controller,
    make_plausibility_check,
)
from torque_safety_controller.node.declared import covered_row, declared_robot, longest_way
from torque_safety_controller.node.driving import Driving
from torque_safety_controller.node.goals import GoalSubscriber
from torque_safety_controller.node.position_control import PositionControl
from torque_safety_controller.node.recovery import STUCK, Recovery
from torque_safety_controller.node.reports.collision_report import CollisionReport
from torque_safety_controller.node.reports.controller_report import (
    LEVELS,
    Shortfall,
    StepRecord,
    goal_too_heavy,
    too_weak,
)
from torque_safety_controller.node.reports.state_publisher import StatePublisher
from torque_safety_controller.node.streams.joint_commands import JointCommands
from torque_safety_controller.node.streams.limits import LimitsReader
from torque_safety_controller.node.streams.states import UNSEEN, StateStream
from torque_safety_controller.node.topics import GOALS
from torque_safety_controller.node.wrenches import WrenchSubscriber
from torque_safety_controller.parameters.controller_parameters import ControllerConfiguration
from torque_safety_controller.qp import AccelerationRange
from torque_safety_controller.safety.handover import Control, Handover
from torque_safety_controller.safety.modes import Mode, ModeKeeper
from viability_bounds_pkg.ros.arm_node import ArmNode
from viability_bounds_pkg.ros.messages import Arrival, Diagnostics, PeriodCheck
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

_QUIET = 1.5
"""Time without a joint state after which the robot is silent, in times of `bounds_timeout`."""

_SILENT = "no joint state"
_STALE = "acceleration limits are stale"
_CONTESTED = "several nodes publish goals"


class ControllerNode(ArmNode):
    """Answers each joint state, once its acceleration limits are there, with torques.

    Subscribes to ``joint_states`` or ``estimated_joint_states``, to ``acceleration_limits`` and
    goals; publishes ``joint_commands`` with the stamp of the state answered. The service
    ``~/enable_torque`` hands over between the robot's position control and torque.
    """

    NAME = "controller_node"
    PARAMETERS = ControllerConfiguration

    def __init__(self, **node_arguments: Any) -> None:
        super().__init__(**node_arguments)
        with self.starting(JOINT_COMMANDS):
            self._node_parameters = NodeParameters(self, ControllerConfiguration, self._configure)
            config = self._node_parameters.configuration
            declared = declared_robot(self)
            self._controller, base = make_controller(config, self, declared)
        self._config = config
        self._handover = Handover(
            config.start_control,
            config.joints,
            config.position_min,
            config.position_max,
            config.torque_max,
            config.dt,
        )
        check = make_plausibility_check(config, declared)
        self._states = StateStream(config.joints, config.state_timeout, self._warn, check)
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
        self._driving = Driving(self, self._goals, self._controller, config, base, self._states)
        self._modes = ModeKeeper()
        self._before = self._modes.mode, self._modes.reason  # what they were before silence
        self._recovery = Recovery(
            self._states,
            config,
            covered_row(declared),
            longest_way(declared),
            partial(self._later, self._warn),
        )
        self._record = StepRecord(len(config.joints))
        self._shortfall = Shortfall(config.joints, config.position_min, config.position_max)
        self._collision = CollisionReport(self.get_logger(), self._controller.constraints)

        self._commands = JointCommands(self, config.joints, config.ros2_control_topic)
        self._drives = PositionControl(
            self,
            config,
            self._handover,
            self._controller,
            self._states,
            self._limits,
            self._goals,
            self._commands,
            self._enter,
        )
        self._published = StatePublisher(self, self._controller, config, base, self._states)
        self._states_topic = states.subscription(self, self._on_state).topic_name
        limits = ACCELERATION_LIMITS.subscription(self, self._on_limits)
        self._limits_topic = limits.topic_name
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
        clipped = "; torque_rate_max is clipped: limits are not promised with it"
        avoiding = "with" if config.collision.collision_avoidance else "without"
        self.announce(
            config.joints,
            config.rate_hz,
            f"{config.start_control} control, integral action {config.integral.integral_action}, "
            f"{avoiding} collision avoidance{clipped if config.clips_torque_rates else ''}",
        )

    def _configure(self, config: ControllerConfiguration) -> None:
        self._config = config
        configure(self._controller, config)

    # Streams

    def _on_state(self, message: JointState) -> None:
        if not self.publisher_watch.admits(self._states_topic):
            return
        states, stamp = self._states, message.header.stamp
        arrival = states.read(message, time.monotonic())
        if arrival is not Arrival.NEW and not self._begins(arrival, stamp):
            return
        if states.unseen and self._handover.by_drives:
            # They would jump to where the arm was held before, from where it has been put.
            self._handover.robot_was_away()
        if self._handover.control is Control.POSITION:
            self._recovery.motors.reset()
            self._drives.hold(stamp)
        elif self._limits.stamp == states.stamp:
            self._track(stamp)
        elif self._limits.lost:
            self._hold(stamp)

    def _begins(self, arrival: Arrival, stamp: Any) -> bool:
        """Deal with a state that is not the next one; return whether the arm begins anew."""
        states = self._states
        if arrival is Arrival.REFUSED:
            self._on_refused(stamp)
        elif arrival is not Arrival.REPEATED:
            self._begin(arrival)
            return True
        elif states.answered_stamp == states.stamp:
            if self._recovery.motors.stuck:  # a robot that waits for the answer, as in lockstep
                self._recovery.motors.retry()
            elif self._modes.reason == _SILENT:  # it was late only
                self._enter(*self._before)
            self._commands.again(stamp)
        return False

    def _on_refused(self, stamp: Any) -> None:
        """Leave the arm to the robot's own stop, or to its drives: nothing is known of it."""
        states = self._states
        if states.answered_stamp < 0 or self._modes.mode is Mode.STOPPED:
            return
        in_row = states.count_refused()
        if self._handover.by_drives:
            self._drives.hold(stamp)
        elif in_row == UNSEEN:
            self._recovery.why = states.why_refused
            self._enter(Mode.STOPPED, states.why_refused)

    def _begin(self, arrival: Arrival) -> None:
        """Start anew: the robot was silent, or restarted."""
        states = self._states
        if states.missed:
            self._recovery.why = "joint states were missing"
        if arrival is Arrival.RESTARTED and self._limits.stamp == states.answered_stamp:
            self._limits.stamp = -1  # from before the restart; its stamps may come again
        if self._by_others():
            self._recovery.why = "the motors held the arm before"
        states.begin()
        self._recovery.motors.reset()
        self._controller.reset(states.q)
        self._handover.robot_was_away()

    def _by_others(self) -> bool:
        """Return whether the motors are on, as far as is known, though nothing is commanded."""
        effort = self._states.effort()
        return effort is None or bool(effort.any())

    def _on_limits(self, message: JointTrajectory) -> None:
        if not (self.publisher_watch.admits(self._limits_topic) and self._limits.read(message)):
            return
        if self._limits.stamp == self._states.stamp != self._states.answered_stamp:
            self._track(message.header.stamp)
        elif self._limits.stamp == self._states.stamp:
            # Limits come again, but this state has been answered in HOLD already.
            self._limits.lost = False

    def _track(self, stamp: Any) -> None:
        """Answer the newest state, whose acceleration limits are there."""
        self._limits.lost = False
        if self._handover.by_drives:
            self._drives.go_on(stamp)
            return
        state = State(self._states.q, self._states.v)
        self._goals.apply_due(self._states.stamp, state)
        if not self._sees_motors():
            return
        contested = self._goals.contested
        if contested:
            self._recovery.why = _CONTESTED
        else:
            self._recovery.slow()
        self._recovery.look()
        limits = AccelerationRange(self._limits.lower, self._limits.upper)
        lost = contested or self._goals.lost
        track = not lost and self._handover.control is not Control.GIVING_BACK
        order = self._recovery.order._replace(track=track)
        step = self._controller.step(state, limits, order, self._states.elapsed())
        self._recovery.note(step)
        self._answer(step, stamp)

    def _sees_motors(self) -> bool:
        """Return whether the newest state is to be answered; else the robot is to stop itself."""
        if self._recovery.sees_motors():
            return True
        self._states.answered()  # by silence
        self._enter(Mode.STOPPED, STUCK)
        return False

    def _answer(self, step: ControlOutput, stamp: Any) -> None:
        """Publish the torques of `step` for the state with `stamp`."""
        states, now = self._states, time.monotonic()
        elapsed = states.elapsed() or 0.0
        self._commands.torque(step.tau, stamp)
        self._recovery.motors.note(step.tau)
        states.answered()
        self._record.note(step, now - states.message_at)
        self._wrenches.note()
        self._collision.note(step)
        self._recovery.why = self._recovery.why or step.failure
        if step.tracking and not self._recovery.why:
            self._enter(Mode.TRACKING, "goal")
        else:
            self._enter(Mode.HOLD, self._why_hold(step))
        if self._handover.control is Control.GIVING_BACK:
            self._handover.slow_down(states.q, states.v, elapsed)

    def _why_hold(self, step: ControlOutput) -> str:
        if step.failure:
            return f"solver failed: {step.failure}"
        if self._limits.lost:
            return _STALE
        if self._handover.control is Control.GIVING_BACK:
            return "on the way to position control"
        if self._controller.lost:
            return "no plan within all limits is known"
        if self._goals.contested:
            return _CONTESTED
        if self._goals.lost:
            return "goal lost"
        if self._controller.goals.any:
            return f"comes to rest: {self._recovery.why}"
        return "no goal"

    def _hold(self, stamp: Any) -> None:
        """Answer the newest state without acceleration limits."""
        if not self._sees_motors():
            return
        self._recovery.why = _STALE
        self._recovery.slow()  # an arm within margins returns gently here, too
        self._recovery.look()
        state = State(self._states.q, self._states.v)
        order = self._recovery.order._replace(track=False)
        self._answer(self._controller.step(state, None, order, self._states.elapsed()), stamp)

    # Watchdogs

    def _watch(self) -> None:
        now, config, states = time.monotonic(), self._config, self._states
        quiet = now - states.message_at > _QUIET * config.bounds_timeout
        if quiet or states.silent(now):
            if self._modes.mode is not Mode.STOPPED:
                self._before = self._modes.mode, self._modes.reason
                silent = self.publisher_watch.several or _SILENT
                self._enter(Mode.STOPPED, silent if quiet else states.why_refused)
            return
        if states.waits(now) > config.bounds_timeout:
            self._limits.lost = True
            if self._handover.control is Control.TAKING_OVER:
                self._drives.fail(_STALE)
            if self._handover.by_drives:
                self._drives.hold(states.message_stamp)
            else:
                self._hold(states.message_stamp)

    def _enter(self, mode: Mode, reason: str) -> None:
        before = self._modes.mode
        if self._modes.set(mode, reason):
            self._later(self._tell, mode, reason, mode is not before)

    def _later(self, tell: Callable[..., None], *what: Any) -> None:
        """Tell something when the command has left: at 1 kHz a log line takes half a period."""
        if self.executor is None:
            tell(*what)
        else:
            self.executor.create_task(tell, *what)

    def _tell(self, mode: Mode, reason: str, new: bool) -> None:
        if new:
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
            | self._recovery.values()
            | {
                "mode": self._modes.mode.value,
                "reason": self._modes.reason,
                "mode_changes": self._modes.changes,
                "control": self._handover.control.value,
                "integral_action": self._config.integral.integral_action,
                "integral_lambda": self._controller.integral_gain,
                "torque_rate_max": "clipped" if self._config.clips_torque_rates else "none",
                "goals_pending": len(self._goals),
                "goals_refused": self._goals.refused,
                "states_refused": self._states.refused,
                "limits_refused": self._limits.refused,
            }
        )
        level, text = LEVELS[self._modes.mode], f"{self._modes.mode.value}: {self._modes.reason}"
        weak = too_weak(self._config.joints, self._controller)
        weak = weak and f"the arm cannot be held where it would come to rest: {weak}"
        heavy = goal_too_heavy(self._config.joints, self._controller)
        heavy = heavy and f"the goal cannot be held: {heavy}"
        troubles = (
            self._recovery.rate.trouble,
            self._collision.too_near,
            self._wrenches.trouble,
            weak,
            heavy,
        )
        for trouble in filter(None, troubles):
            level, text = max(level, DiagnosticStatus.WARN), f"{text}; {trouble}"
        short = self._shortfall.look(self._controller, 1e-9 * self._states.stamp)
        short = short if self._modes.mode is Mode.TRACKING else ""
        values["short_of_goal"] = short or "none"
        if short:
            text += f"; {short}"
        return level, text, values


def main(args: list[str] | None = None) -> int:
    """Run the controller node until it is told to stop."""
    return run(ControllerNode, args)


if __name__ == "__main__":
    sys.exit(main())
