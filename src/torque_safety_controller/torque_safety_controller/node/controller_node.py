# SPDX-License-Identifier: Apache-2.0
"""The controller node: joint states, acceleration limits and goals in, joint torques out."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool
from trajectory_msgs.msg import JointTrajectory

from torque_safety_controller.command_check import CommandCheck
from torque_safety_controller.handover import Handover, HandoverRefused
from torque_safety_controller.modes import Control, Mode
from torque_safety_controller.node.assembly import make_controller
from torque_safety_controller.node.declared import (
    commands_in_flight,
    covered_misses,
    declared_robot,
    limits_jerk,
)
from torque_safety_controller.node.goals import GoalSubscriber
from torque_safety_controller.node.periodic import UNSEEN, JointCommands, LimitsReader, StateStream
from torque_safety_controller.node.reports import ControllerReport, StatePublisher
from torque_safety_controller.node.topics import ENABLE_TORQUE
from torque_safety_controller.node.wrenches import WrenchSubscriber
from torque_safety_controller.parameters.controller_parameters import ControllerConfiguration
from torque_safety_controller.parts.contact.interaction import Interaction
from torque_safety_controller.qp import AccelerationRange
from torque_safety_controller.step import too_weak_at
from torque_safety_controller.supervisor import Supervisor
from viability_bounds_pkg.node.bounds_parameters import make_plausibility_check
from viability_bounds_pkg.robot.gravity import gravity_beyond
from viability_bounds_pkg.ros.arm_node import ArmNode
from viability_bounds_pkg.ros.diagnostics import Diagnostics
from viability_bounds_pkg.ros.messages import Arrival
from viability_bounds_pkg.ros.parameters import NodeParameters
from viability_bounds_pkg.ros.payload import PayloadSubscriber
from viability_bounds_pkg.ros.program import run
from viability_bounds_pkg.ros.runtime import steady_timer
from viability_bounds_pkg.ros.topics import ACCELERATION_LIMITS
from viability_bounds_pkg.state import State

Array = NDArray[np.float64]

QUIET = 1.5
"""Time without a joint state after which the robot is silent, in times of `bounds_timeout`."""


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
        with self.starting():
            self._node_parameters = NodeParameters(self, ControllerConfiguration, self._configure)
            config = self._node_parameters.configuration
            declared = declared_robot(self)
            self._controller, base, self._locked = make_controller(config, self, declared)
        self._config, self._base = config, base
        self._handover = Handover(
            config.joints, config.position_min, config.position_max, config.torque_max, config.dt
        )
        check = None
        if not config.use_estimated_states:
            errors = None if declared is None else declared.declared
            check = make_plausibility_check(config, errors)
        model = self._controller.robot.model
        self._gravity = gravity_beyond(model, config.command_includes_gravity)
        self._states = StateStream(
            config.joints,
            config.state_timeout,
            self._warn,
            check,
            config.continuous,
            gravity_beyond(model, config.effort_includes_gravity),
        )
        self._limits = LimitsReader(config.joints, self._warn)
        self._goals = GoalSubscriber(self, self._controller, config, base, self._states)
        self._wrenches = WrenchSubscriber(
            self, self._controller.find(Interaction), self._goals.waiting, config, base
        )
        self._payload = PayloadSubscriber(self, self._controller.robot.payload, self._on_payload)
        self._supervisor = Supervisor(
            config.dt,
            config.start_control,
            covered_misses(declared),
            config.bounds_timeout,
            CommandCheck(
                (config.effort_tolerance or math.inf) * config.torque_max,
                commands_in_flight(declared),
            ),
            self._on_mode,
            lambda line: self._later(self._warn, line),
        )
        self._report = ControllerReport(
            self,
            config,
            self._controller,
            self._supervisor,
            self._states,
            {
                "goals_refused": self._goals.waiting.refused,
                "states_refused": self._states.refused,
                "limits_refused": self._limits.refused,
                "wrenches_refused": self._wrenches.refused,
                "payload_refused": self._payload.refused,
            },
            self._goals,
        )
        with self.starting():
            self._commands = JointCommands(
                self, config.joints, config.ros2_control_topic, limits_jerk(declared)
            )
        self._published = StatePublisher(self, self._controller.robot, config, base, self._states)
        ENABLE_TORQUE.serve(self, self._on_enable_torque)
        self.listen_to_states(config.use_estimated_states, self._on_state, config.joints)
        self.listen(ACCELERATION_LIMITS, self._on_limits)
        period = min(config.bounds_timeout, config.state_timeout) / 4
        self._watchdog = steady_timer(self, period, self._watch)
        self._diagnostics = Diagnostics(self, self._report, self.publisher_watch)
        self.announce(config.joints, config.rate_hz, config.summary)

    def _configure(self, config: ControllerConfiguration) -> None:
        self._config = config
        self._controller.configure(config.settings)

    def _on_payload(self) -> None:
        controller, states = self._controller, self._states
        controller.remodel()
        self.get_logger().info(f"payload: {controller.robot.payload}")
        if states.message is None:  # nobody knows where the arm stands
            return
        if weak := too_weak_at(controller.robot.model, states.q, controller.tau_max):
            self.get_logger().warning(f"payload: too heavy where the arm stands: {weak}")

    # Streams

    def _on_state(self, message: JointState) -> None:
        states, stamp = self._states, message.header.stamp
        arrival = states.read(message, time.monotonic())
        if arrival is Arrival.REFUSED:
            self._on_refused(stamp)
            return
        if arrival is Arrival.REPEATED:
            if states.answered_stamp == states.stamp:
                self._supervisor.repeated()
                self._commands.again(stamp)
            return
        if arrival is not Arrival.NEW:
            self._look_at_locked()
            self._start_over(arrival)
        elif states.unseen and self._supervisor.by_drives:
            # They would jump to where the arm was held before, from where it has been put.
            self._put_elsewhere()
        if self._limits.stamp == states.stamp:
            self._answer(stamp, self._limits.range)
        elif self._supervisor.control is Control.POSITION or self._supervisor.stale:
            self._answer(stamp, None)
        if self._locked.due(states.stamp):
            self._later(self._look_at_locked)

    def _look_at_locked(self) -> None:
        """Have the model follow joints that it has locked."""
        states, locked = self._states, self._locked
        if states.message is None:
            return
        before = self._base.copy()
        if locked.look(states.message.name, states.message.position, states.stamp):
            self._controller.remodel()
            self._goals.base_moved(self._base * before.inverse())
        for line in locked.news():
            self.get_logger().info(line)
        for line in locked.refused():
            self._warn(line)

    def _on_limits(self, message: JointTrajectory) -> None:
        if not self._limits.read(message):
            return
        if self._limits.stamp == self._states.stamp != self._states.answered_stamp:
            self._answer(message.header.stamp, self._limits.range)
        elif self._limits.stamp == self._states.stamp:
            self._supervisor.limits_came()

    def _on_refused(self, stamp: Any) -> None:
        """Leave the arm to the robot's own stop, or to its drives: nothing is known of it."""
        states = self._states
        if states.answered_stamp < 0 or self._supervisor.mode is Mode.STOPPED:
            return
        states.refused_in_row += 1
        if self._supervisor.by_drives:
            self._hold(stamp)
        elif states.refused_in_row == UNSEEN:
            self._supervisor.refused(states.why_refused)

    def _start_over(self, arrival: Arrival) -> None:
        """Start anew: the robot was silent, or restarted."""
        states, reason = self._states, ""
        if arrival is Arrival.RESTARTED and self._limits.stamp == states.answered_stamp:
            self._limits.stamp = -1  # from before the restart; its stamps may come again
        effort = states.effort()
        if effort is None or effort.any():  # though nothing is commanded
            reason = "the motors held the arm before"
        elif states.missed:
            reason = "joint states were missing"
        states.forget_answers()
        self._controller.reset(states.q)
        self._supervisor.robot_returned(reason)
        self._handover.release()

    def _put_elsewhere(self) -> None:
        self._supervisor.put_elsewhere()
        self._handover.release()

    def _answer(self, stamp: Any, limits: AccelerationRange | None) -> None:
        """Answer the newest state, whose acceleration limits are there or do not come."""
        states, supervisor, goal, moved = self._states, self._supervisor, "", ""
        state, elapsed = State(states.q, states.v), states.elapsed()
        if not supervisor.by_drives:
            self._goals.apply_due(states.stamp, state)
            goal, moved = self._goals.trouble, self._locked.moving
        if moved:
            moved += " moves, which is locked in the model"
        effort = states.effort()
        order = supervisor.state(elapsed, state.v, effort, limits is not None, goal, moved)
        if supervisor.by_drives:
            self._hold(stamp)
            states.mark_answered()
            if supervisor.control is Control.TAKING_OVER and limits is not None:
                self._take_over(state, limits)
            supervisor.answered()
            return
        step = self._controller.step(state, limits, order, elapsed)
        self._commands.accelerations(step.a, stamp)
        self._commands.torque(self._for_robot(step.tau, state), stamp)
        states.mark_answered()
        supervisor.answered(step.tau, step.failure, step.planned)
        self._report.add(step, time.monotonic() - states.message_at)
        self._wrenches.log_changes()

    def _for_robot(self, tau: Array, state: State) -> Array:
        """Return torques of the motors less what the robot adds, in the middle of the period."""
        if self._gravity is None:
            return tau
        return tau - self._gravity(state.q + 0.5 * self._config.dt * state.v)

    # Handover

    def _hold(self, stamp: Any) -> None:
        """Have the drives hold the arm, in the turns in which they report continuous joints."""
        states = self._states
        self._commands.accelerations(np.zeros(len(states.q)), stamp)
        self._commands.position(self._handover.hold(states.q) - states.turns, stamp)

    def _take_over(self, state: State, limits: AccelerationRange) -> None:
        """Prepare to go on with torque from the next state, if that of the motors is known."""
        if self._goals.apply_due(self._states.stamp, state):
            self.get_logger().warning("goals from before the handover are dropped")
        try:
            found = self._handover.torque(state.q, self._states.effort())
            if found is None:
                return
            step = self._controller.resume(state, limits, found.mean)
            if step.failure:
                raise HandoverRefused(f"solver failed: {step.failure}")
        except HandoverRefused as error:
            self._supervisor.change("failed", f"handover failed: {error}")
            return
        self._handover.release()
        self._supervisor.change("torque known", "enable_torque")
        self.get_logger().info(
            f"torque of the motors at the handover: from {found.samples} states, off by at most "
            f"{found.error.max():.2%} of torque_max"
        )

    def _on_enable_torque(
        self, request: SetBool.Request, response: SetBool.Response
    ) -> SetBool.Response:
        """Start a handover, or say why not."""
        try:
            self._check_enable(request.data)
        except HandoverRefused as error:
            response.message = str(error)
            self.get_logger().warning(f"enable_torque refused: {error}")
            return response
        self._supervisor.enable(request.data)
        what = "torque control begins when the torque of the motors is known"
        response.message = what if request.data else "position control begins when the arm rests"
        response.success = True
        return response

    def _check_enable(self, torque: bool) -> None:
        """Raise `HandoverRefused` where a handover cannot begin."""
        states, config, control = self._states, self._config, self._supervisor.control
        if torque == (control in (Control.TORQUE, Control.TAKING_OVER)):
            raise HandoverRefused(f"{'torque' if torque else 'position'} control is on already")
        silence = time.monotonic() - states.usable_at
        if silence > (config.bounds_timeout if torque else config.state_timeout):
            raise HandoverRefused("no joint state, or only old ones")
        if not torque:
            return
        # After a restart of the robot, earlier limits may have later stamps.
        apart = 1e-9 * abs(states.stamp - self._limits.stamp)
        if self._limits.stamp < 0 or apart > config.bounds_timeout:
            raise HandoverRefused("no acceleration limits, or only old ones")
        if control is Control.POSITION:
            self._handover.start(states.q, states.effort())

    # Watchdogs

    def _watch(self) -> None:
        now, config, states = time.monotonic(), self._config, self._states
        source = " from estimator_node" if self.uses_estimates else ""
        nothing = self.publisher_watch.trouble or f"no joint state{source}"
        if now - states.message_at > QUIET * config.bounds_timeout:
            self._supervisor.silent(nothing)
        elif states.silent(now):
            self._supervisor.silent(states.why_refused or nothing)
        elif states.waits(now) > config.bounds_timeout:
            self._limits.check_clock(states.stamp)
            self._answer(states.message_stamp, None)

    def _on_mode(self, mode: Mode, reason: str) -> None:
        self._later(self._tell, mode, reason)

    def _later(self, tell: Callable[..., None], *what: Any) -> None:
        """Tell something when the command has left: at 1 kHz a log line takes half a period."""
        if self.executor is None:
            tell(*what)
        else:
            self.executor.create_task(tell, *what)

    def _tell(self, mode: Mode, reason: str) -> None:
        self._published.mode(mode)
        text = f"{mode.value}: {reason}"
        # One call site per severity: rclpy ties the two together.
        if mode in (Mode.TRACKING, Mode.POSITION):
            self.get_logger().info(text)
        else:
            self.get_logger().warning(text)
        self._diagnostics.publish()


def main(args: list[str] | None = None) -> int:
    """Run the controller node until it is told to stop."""
    return run(ControllerNode, args)


if __name__ == "__main__":
    sys.exit(main())
