# SPDX-License-Identifier: Apache-2.0
"""What a task is."""

from __future__ import annotations

from typing import Protocol

from torque_safety_controller.qp import TaskTerm
from torque_safety_controller.robot_model import RobotModel


class Task(Protocol):
    """Anything that asks for accelerations of the arm in its current state."""

    def term(self, robot: RobotModel) -> TaskTerm:
        """Return the term of the QP's cost for one step.

        Args:
            robot: updated to the current state.
        """
