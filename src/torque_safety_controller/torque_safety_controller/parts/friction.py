# SPDX-License-Identifier: Apache-2.0
"""Friction compensation as a part of the controller."""

from __future__ import annotations

from typing import Any

from torque_safety_controller.friction.compensation import FrictionCompensation
from torque_safety_controller.robot_model import RobotModel
from torque_safety_controller.settings import Settings
from torque_safety_controller.step import Part, Step


class Friction(Part):
    """Adds the torque that compensates friction where a joint is wanted to go.

    Args:
        compensation: finds it.
    """

    def __init__(self, compensation: FrictionCompensation) -> None:
        self.compensation = compensation

    def configure(self, settings: Settings) -> None:
        """See `Part.configure`."""
        self.compensation.settings = settings.friction

    def reset(self, robot: RobotModel) -> None:
        """See `Part.reset`."""
        self.compensation.reset()

    def prepare(self, step: Step) -> None:
        """Add the torque to that of the model."""
        robot, known = step.robot, step.elapsed if step.learns else 0.0
        step.torque = step.torque + self.compensation.torque(
            robot.M, robot.v, step.a_last, known, robot.dt
        )

    def report(self) -> dict[str, Any]:
        """See `Part.report`."""
        return {"friction_torque_nm": self.compensation.last}
