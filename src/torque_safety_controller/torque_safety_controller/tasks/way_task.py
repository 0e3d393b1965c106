# SPDX-License-Identifier: Apache-2.0
"""The task that keeps the joints on a straight way to a posture, at whatever pace."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from torque_safety_controller.qp.terms import TaskTerm
from torque_safety_controller.robot_model import RobotModel
from torque_safety_controller.tasks.posture_task import PostureTask

ALONG = 1e-3
"""What an error of acceleration along the way counts beside one across it. An arm at the edge of
what it can hold begins with accelerations of 1e-3 rad/s^2, while kp asks for several rad/s^2."""


@dataclass(slots=True)
class WayTask(PostureTask):
    """Brings the joints to `q_des`, rather late than off the straight line.

    Where the torques do not suffice for what is asked for, the acceleration nearest to it leads
    off the line, along what can just be held, and may lead nowhere. Here it is the one on the
    line: the arm gathers speed as torque becomes free.
    """

    def term(self, robot: RobotModel) -> TaskTerm:
        """Return that of `PostureTask`, in which errors along the line count less."""
        _, b, weight = PostureTask.term(self, robot)
        line = self.q_des - robot.q
        A = np.eye(line.size)
        A -= (1.0 - ALONG) / max(float(line @ line), 1e-12) * np.outer(line, line)
        return TaskTerm(A, A @ b, weight)
