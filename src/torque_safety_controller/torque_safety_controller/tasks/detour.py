# SPDX-License-Identifier: Apache-2.0
"""Leads an arm that stands short of its goal along a way that it can hold."""

from __future__ import annotations

from dataclasses import replace
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from torque_safety_controller.robot_model import RobotModel
from torque_safety_controller.tasks.detour_search import DetourSearch, Goal
from torque_safety_controller.tasks.pose_task import PoseTask, pose_error
from torque_safety_controller.tasks.posture_task import PostureTask
from torque_safety_controller.tasks.task import Task
from torque_safety_controller.tasks.way_search import Search, Way

Array = NDArray[np.float64]

STILL = 0.05
"""Speed below which the arm stands, rad/s."""

SHORT = 1e-3
"""Error of the pose from which on an arm that stands is short of its goal, m and rad."""

NEAR = 0.02
"""Distance from their goal, or from the end of a way, at which joints are there, rad."""

GIVEN = 0.3
"""Share of the acceleration asked for below which the QP gives none."""

PATIENCE = 0.2
"""How long the arm stands before a way is searched for, s."""

WORK = 5000.0
"""Postures that a search looks at in a second."""

PACE = 1.6
"""Speed of the fastest joint on a way, rad/s; less where gains are low."""

FARTHEST = 0.4
"""How far at most the posture that leads is ahead of the arm, rad."""

LOST = 3.0
"""How many times as far behind it the arm is lost."""

LONGEST = 1.0
"""How long the posture that leads may wait, s, besides the time in which the arm settles."""

ATTEMPTS = 5
"""Ways to one goal that are tried."""


class Progress(Enum):
    """What is done about an arm that stands short of its goal."""

    NONE = "none"
    SEARCHING = "a way to the goal is searched for"
    LED = "on a detour to the goal"
    NO_WAY = "no way to the goal was found"
    NOT_HELD = "goal cannot be held"


class Detour:
    """Replaces the tasks by one that leads the arm, where they would let it stand for ever.

    The safety filter lets the arm glide along postures that it can just hold, and limits of joints
    hold it as well, as far as that brings it nearer to its goal. There it may stand, because a
    joint would have to move away from its goal for another to go on. The sign of it: the arm
    stands, and the QP gives none of the acceleration that the error asks for. An arm that somebody
    holds, or friction, is given it; so it is not led.

    A way is searched for bit by bit, `WORK` in a second, while the tasks stay what they are. Then
    a posture moves along it, ahead of the arm, until the arm is at its end. Then the tasks are
    those of the goal again; for a pose, the posture at the end is kept in the null space. Limits
    are kept by what kept them before: only the goal of the QP changes.

    Args:
        search: for ways of this arm.
        dt: control period, s.

    Attributes:
        progress: what is done now.
        lead: posture that leads the arm while it is led, shape (n,), rad.
        load: what would hold the goal that cannot be held, as a share of what it may need, shape
            (n,).
    """

    def __init__(self, search: DetourSearch, dt: float) -> None:
        self._ways, self._dt = search, dt
        self._goal: Goal | None = None
        self.lead = self.load = np.zeros(0)
        self.reset()

    def reset(self) -> None:
        """Forget the past."""
        self.progress = Progress.NONE
        self._time = self._work = 0.0
        self._attempts = 0
        self._search: Search[Way | None] | None = None
        self._left: Way = []
        self._end: Array | None = None

    def tasks(self, tasks: list[Task], robot: RobotModel) -> list[Task]:
        """Return the tasks of a step: those given, or one that leads the arm.

        Args:
            tasks: that of the pose, if any, and that of the posture, last.
            robot: updated to the current state.
        """
        first, posture = tasks[0], tasks[-1]
        if not isinstance(first, PoseTask | PostureTask) or not isinstance(posture, PostureTask):
            return tasks
        goal = Goal(first.pose_des if isinstance(first, PoseTask) else None, posture.q_des)
        if self._goal is None or not goal.same_as(self._goal) or first.kp == 0.0:
            self.reset()
        self._goal = goal
        if first.kp == 0.0:
            return tasks
        if self.progress is Progress.LED:
            self._follow(robot.q, first.kp / first.kd)
        elif self.progress in (Progress.NONE, Progress.SEARCHING):
            stands = self._stands(first, robot)
            self._time = self._time + self._dt if stands else max(self._time - self._dt, 0.0)
            if self._time > PATIENCE + 0.5 * self._dt:
                self._look_for_way(robot.q, goal)
            elif self._time == 0.0:
                self.progress, self._search = Progress.NONE, None
        if self.progress is Progress.LED:
            return [PostureTask(self.lead, first.kp, first.kd, first.weight)]
        if self._end is not None and posture is not first:
            return [first, replace(posture, q_des=self._end)]
        return tasks

    def _stands(self, task: PoseTask | PostureTask, robot: RobotModel) -> bool:
        """Return whether the arm stands short of a goal, and is to stand."""
        if np.abs(robot.v).max() > STILL:
            return False
        if isinstance(task, PoseTask):
            short = np.abs(pose_error(robot.pose, task.pose_des)).max() > SHORT
        else:
            short = np.abs(task.q_des - robot.q).max() > NEAR
        if not short:
            return False
        A, b, _ = task.term(robot)
        given = robot.a_last if A is None else A @ robot.a_last
        return float(np.linalg.norm(given)) < GIVEN * float(np.linalg.norm(b))

    def _look_for_way(self, q: Array, goal: Goal) -> None:
        """Do the work of a step."""
        if self._search is None:
            if goal.pose is None and not self._ways.can_hold(goal.q):
                self.progress, self.load = Progress.NOT_HELD, np.abs(self._ways.load(goal.q))
                return
            # A seed for each attempt: the same motion each time, and another way each attempt.
            rng = np.random.default_rng(self._attempts)
            self._attempts += 1
            self.progress, self._work = Progress.SEARCHING, 0.0
            self._search = self._ways.ways(q.copy(), goal, rng)
        self._work += WORK * self._dt
        try:
            while self._work > 0.0:
                self._work -= next(self._search)
        except StopIteration as found:
            self._search, self._time = None, 0.0
            if found.value is None:
                self.progress = Progress.NO_WAY
            else:
                self.progress = Progress.LED
                self.lead, *self._left = found.value

    def _follow(self, q: Array, rate: float) -> None:
        """Move the posture that leads, and see whether the arm comes with it.

        Args:
            q: positions, shape (n,), rad.
            rate: speed of the arm by its distance from that posture, 1/s.
        """
        ahead = min(FARTHEST, PACE / rate)
        apart = float(np.abs(self.lead - q).max())
        self._time += self._dt
        if not self._left and apart < NEAR:
            self._end = self.lead
            self.progress, self._time = Progress.NONE, 0.0
        elif apart > LOST * ahead or self._time > LONGEST + 4.0 / rate:
            # Pushed away, or stuck again.
            self.progress = Progress.NONE if self._attempts < ATTEMPTS else Progress.NO_WAY
            self._time = 0.0
        elif self._left and apart < ahead:
            if ahead - apart > 0.1 * PACE * self._dt:
                self._time = 0.0
            piece = self._left[0] - self.lead
            length = float(np.abs(piece).max())
            if length <= ahead - apart:
                self.lead = self._left.pop(0)
            else:
                self.lead = self.lead + (ahead - apart) / length * piece
