# SPDX-License-Identifier: Apache-2.0
"""Position control by the robot's drives, and the handover from and to it."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from std_srvs.srv import SetBool

from torque_safety_controller.controller import Controller
from torque_safety_controller.node.goals import GoalSubscriber
from torque_safety_controller.node.streams.joint_commands import JointCommands
from torque_safety_controller.node.streams.limits import LimitsReader
from torque_safety_controller.node.streams.states import StateStream
from torque_safety_controller.node.topics import ENABLE_TORQUE
from torque_safety_controller.parameters.controller_parameters import ControllerConfiguration
from torque_safety_controller.qp import AccelerationRange
from torque_safety_controller.safety.handover import Control, Handover, HandoverRefused
from torque_safety_controller.safety.modes import Mode
from viability_bounds_pkg.state import State


class PositionControl:
    """Answers states with positions, and serves ``~/enable_torque``.

    Args:
        node: serves and logs.
        config: has the time-outs.
        handover: which control it is; this changes it.
        controller: prepared for the torque of the motors at the handover.
        states: which are answered.
        limits: of the accelerations.
        goals: those from before the handover are dropped.
        commands: to the robot.
        enter: told the mode and why.
    """

    def __init__(
        self,
        node: Node,
        config: ControllerConfiguration,
        handover: Handover,
        controller: Controller,
        states: StateStream,
        limits: LimitsReader,
        goals: GoalSubscriber,
        commands: JointCommands,
        enter: Callable[[Mode, str], None],
    ) -> None:
        self._logger, self._config, self._enter = node.get_logger(), config, enter
        self._handover, self._controller = handover, controller
        self._states, self._limits, self._goals = states, limits, goals
        self._commands = commands
        ENABLE_TORQUE.serve(node, self._on_enable_torque)

    def hold(self, stamp: Any) -> None:
        """Answer the newest state with the position that the drives hold."""
        self._commands.position(self._handover.hold(self._states.q), stamp)
        self._states.answered()
        self._enter(Mode.POSITION, self._handover.reason)

    def go_on(self, stamp: Any) -> None:
        """Answer the newest state, whose acceleration limits are there."""
        self.hold(stamp)
        if self._handover.control is Control.TAKING_OVER:
            self._take_over()

    def fail(self, reason: str) -> None:
        """Give up a handover to torque control."""
        self._handover.failed(reason)
        self._logger.error(self._handover.reason)
        self._enter(Mode.POSITION, self._handover.reason)

    def _take_over(self) -> None:
        """Prepare to go on with torque from the next state; this one is still the drives'.

        Not before the torque of the motors is known.
        """
        states = self._states
        if self._goals.apply_due(states.stamp, State(states.q, states.v)):
            self._logger.warning("goals from before the handover are dropped")
        try:
            tau = self._handover.average(states.q, states.effort())
        except HandoverRefused as error:
            self.fail(str(error))
            return
        if tau is None:
            return
        bounds = AccelerationRange(self._limits.lower, self._limits.upper)
        step = self._controller.bumpless_transfer(State(states.q, states.v), bounds, tau)
        if step.failure:
            self.fail(f"solver failed: {step.failure}")
            return
        self._goals.renew()
        self._handover.taken_over()
        found = self._handover.torque
        self._logger.info(
            f"torque of the motors at the handover: from {found.samples} states, off by at most "
            f"{found.error.max():.2%} of torque_max"
        )

    def _on_enable_torque(
        self, request: SetBool.Request, response: SetBool.Response
    ) -> SetBool.Response:
        """Start a handover, or say why not."""
        states, config = self._states, self._config
        silence = time.monotonic() - states.usable_at
        try:
            if request.data:
                # After a restart of the robot, earlier limits may have later stamps.
                apart = 1e-9 * abs(states.stamp - self._limits.stamp)
                bounds_fresh = self._limits.stamp >= 0 and apart <= config.bounds_timeout
                fresh = silence < config.bounds_timeout
                self._handover.to_torque(states.q, states.effort(), fresh, bounds_fresh)
                self._limits.lost = False
                response.message = "torque control begins when the torque of the motors is known"
            else:
                self._handover.to_position(states.q, states.v, silence < config.state_timeout)
                response.message = "position control begins when the arm is at rest"
            response.success = True
        except HandoverRefused as error:
            response.message = str(error)
            self._logger.warning(f"enable_torque refused: {error}")
        return response
