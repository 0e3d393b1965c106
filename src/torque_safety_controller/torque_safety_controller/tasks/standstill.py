# SPDX-License-Identifier: Apache-2.0
"""Tells whether an arm is stuck short of its goal."""

from __future__ import annotations

from math import inf

import numpy as np
from numpy.typing import NDArray

from torque_safety_controller.robot_model import RobotModel
from torque_safety_controller.tasks.pose_task import PoseTask, pose_error
from torque_safety_controller.tasks.posture_task import PostureTask

Array = NDArray[np.float64]

STILL = 0.05
"""Speed below which the arm stands, rad/s."""

SHORT = 5e-4
"""Error from which on an arm is short of its goal: the largest of a joint, rad, or of the pose, m
and rad."""

GIVEN = 0.3
"""Share of the acceleration asked for below which the QP gives none."""

PATIENCE = 0.2
"""How long an arm that is stuck stands, s."""

LOOKED_AT = 1.0
"""How long it may move and not come nearer to its goal, s: to and fro, or creep."""

NEARER = 0.05
"""Share by which the error falls in that time while an arm comes nearer."""


class Standstill:
    """Watches the error of a task, and what the QP gives of the acceleration that it asks for.

    An arm is stuck if it stands short of its goal, or if it moves and does not come nearer, while
    the QP gives, then or on average, none of the acceleration that the error asks for. One that
    somebody holds, or friction, is given it.

    Args:
        dt: control period, s.

    Attributes:
        stands: how long the arm has stood so, s; it takes as long again to forget that.
    """

    def __init__(self, dt: float) -> None:
        self._dt = dt
        self.reset()

    def reset(self) -> None:
        """Forget the past."""
        self.stands = self._time = 0.0
        self._best = inf
        self._given: Array | float = 0.0
        self._asked: Array | float = 0.0

    @property
    def stuck(self) -> bool:
        """Whether the arm is stuck."""
        return self.stands > PATIENCE + 0.5 * self._dt or self.hunts

    @property
    def hunts(self) -> bool:
        """Whether it moves, and has not come nearer for long."""
        return self._time > LOOKED_AT and _none(self._given, self._asked)

    def look(self, task: PoseTask | PostureTask, robot: RobotModel) -> None:
        """Look at a step.

        Args:
            task: that is to bring the arm to its goal.
            robot: updated to the current state.
        """
        A, asked, _ = task.term(robot)
        given = robot.a_last if A is None else A @ robot.a_last
        if isinstance(task, PoseTask):
            error = pose_error(robot.pose, task.pose_des)
            # Of the hand alone, whose acceleration is J a + J' v.
            asked, given = asked[:6] + robot.drift, given[:6] + robot.drift
        else:
            error = task.q_des - robot.q
        short = bool(np.abs(error).max() > SHORT)
        slow = bool(np.abs(robot.v).max() <= STILL)
        if short and slow and _none(given, asked):
            self.stands += self._dt
        else:
            self.stands = max(self.stands - self._dt, 0.0)
        size = float(np.linalg.norm(error))
        if not short or size < (1.0 - NEARER) * self._best:
            self._best, self._time, self._given, self._asked = size, 0.0, 0.0, 0.0
        else:
            self._time += self._dt
            self._given, self._asked = self._given + given, self._asked + asked


def _none(given: Array | float, asked: Array | float) -> bool:
    """Return whether an acceleration is none of the one asked for."""
    return float(np.linalg.norm(given)) < GIVEN * float(np.linalg.norm(asked))
