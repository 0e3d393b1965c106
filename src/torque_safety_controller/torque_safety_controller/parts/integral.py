# SPDX-License-Identifier: Apache-2.0
"""Integral action: torque of the errors of past accelerations, or what is taken over and fades."""

from __future__ import annotations

import math
from typing import Any

from torque_safety_controller.integral_action import FadingTorque
from torque_safety_controller.robot_model import RobotModel
from torque_safety_controller.settings import Settings
from torque_safety_controller.step import Array, Part, Step, joints_named


class Integral(Part):
    """Adds the torque of the integral action, which takes over other torques without a step.

    Args:
        action: in one of its modes.
        robot: of the arm; it has to give the rates of its matrices, if the action needs them.

    Attributes:
        action: as given.
    """

    def __init__(self, action: FadingTorque, robot: RobotModel) -> None:
        self.action, self._robot = action, robot
        robot.rates = action.rates

    def configure(self, settings: Settings) -> None:
        """See `Part.configure`."""
        self.action.settings = settings.integral

    def reset(self, robot: RobotModel) -> None:
        """See `Part.reset`."""
        self.action.reset()

    def prepare(self, step: Step) -> None:
        """Add the torque to that of the model, and say by how much it has changed."""
        action = self.action
        if step.order.forget_integral:
            action.forget()
        before, time = action.last, step.elapsed if step.order.obeyed else math.inf
        torque = action.torque(step.robot, step.robot.v, step.a_last, time)
        step.torque = step.torque + torque
        if torque is not before:
            step.integral_change = torque - before

    def resume(self, step: Step, torque: Array) -> None:
        """See `Part.resume`."""
        self.action.resume(step.robot, step.robot.v, torque)

    def report(self) -> dict[str, Any]:
        """See `Part.report`."""
        return {
            "joints_at_integral_budget": joints_named(self._robot, self.action.saturated),
            "integral_skipped_steps": self.action.skipped,
            "integral_lambda": self.action.gain,
        }
