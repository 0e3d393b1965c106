# SPDX-License-Identifier: Apache-2.0
"""What a task is, and the task that brings the joints to rest."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from torque_safety_controller.qp import TaskTerm
from torque_safety_controller.robot_model import RobotModel

Array = NDArray[np.float64]


class Task(Protocol):
    """Anything that asks for accelerations of the arm in its current state."""

    def term(self, robot: RobotModel) -> TaskTerm:
        """Return the term of the QP's cost for one step.

        Args:
            robot: updated to the current state.
        """


@dataclass(slots=True)
class RestTask:
    """Brings the joints to rest wherever they are.

    Attributes:
        a: accelerations that do, as `Step.rest`, shape (n,), rad/s^2.
    """

    a: Array

    def term(self, robot: RobotModel) -> TaskTerm:
        """Return the accelerations as a term of the cost."""
        return TaskTerm(None, self.a, 1.0)
