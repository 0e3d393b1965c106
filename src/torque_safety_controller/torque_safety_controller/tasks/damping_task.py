# SPDX-License-Identifier: Apache-2.0
"""The task that brings the joints to rest."""

from __future__ import annotations

from dataclasses import dataclass

from torque_safety_controller.qp import TaskTerm
from torque_safety_controller.robot_model import RobotModel


@dataclass(slots=True)
class DampingTask:
    """Brings the joints to rest wherever they are.

    Attributes:
        kd: damping, 1/s.
    """

    kd: float

    def term(self, robot: RobotModel) -> TaskTerm:
        """Return ``a = -kd v`` as a term of the cost."""
        return TaskTerm(None, -self.kd * robot.v, 1.0)
