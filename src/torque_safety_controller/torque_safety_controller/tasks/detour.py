# SPDX-License-Identifier: Apache-2.0
"""Leads an arm that stands short of its goal along a way that it can hold."""

from __future__ import annotations

from dataclasses import replace
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from torque_safety_controller.qp.constraints import AccelerationRange
from torque_safety_controller.robot_model import RobotModel
from torque_safety_controller.tasks.detour_search import DetourSearch, Goal
from torque_safety_controller.tasks.pose_task import PoseTask
from torque_safety_controller.tasks.posture_task import PostureTask
from torque_safety_controller.tasks.standstill import GIVEN, PATIENCE, SHORT, Standstill
from torque_safety_controller.tasks.task import Task
from torque_safety_controller.tasks.way_search import Search, Way
from torque_safety_controller.tasks.way_task import WayTask

Array = NDArray[np.float64]

NEAR = 0.02
"""Distance from the end of a way at which an arm that stands is there, rad."""

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

HELD = 1.0
"""How long an arm that moved is held for a search, s; with each attempt twice as long. It may come
to its goal by itself, later."""

ATTEMPTS = 5
"""Ways to one goal that are tried without a rest; from then on each rest is twice as long."""

LONGEST_REST = 10.0
"""The longest rest, s."""

DOUBLINGS = 10
"""How often times are doubled at most: attempts may go on for days."""


class Progress(Enum):
    """What is done about an arm that stands short of its goal."""

    NONE = "none"
    SEARCHING = "a way to the goal is searched for"
    LED = "on a detour to the goal"
    NO_WAY = "no way to the goal was found"
    NOT_HELD = "goal cannot be held"
    AT_LIMIT = "goal is nearer to a position limit than margins admit"


class Detour:
    """Replaces the tasks by one that leads the arm, where they would let it stand for ever.

    The safety filter lets the arm glide along postures that it can just hold, and limits of joints
    hold it as well, as far as that brings it nearer to its goal. There it may stand, or move to
    and fro, because a joint would have to move away from its goal for another to go on: see
    `Standstill`.

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
        short: how far joints stop before a goal that is too near to their limits, shape (n,), rad.
    """

    def __init__(self, search: DetourSearch, dt: float) -> None:
        self._ways, self._dt = search, dt
        self._watch = Standstill(dt)
        self._goal: Goal | None = None
        self.lead = self.load = self.short = np.zeros(0)
        self.reset()

    def reset(self) -> None:
        """Forget the past."""
        self.progress = Progress.NONE
        self._watch.reset()
        self._time = self._work = self._rest = 0.0
        self._attempts = 0
        self._search: Search[Way | None] | None = None
        self._hunted = False  # whether the search began while the arm moved: it is held then
        self._left: Way = []
        self._closely = False  # whether the arm is to keep to the way, at whatever pace
        self._end: Array | None = None

    def tasks(
        self, tasks: list[Task], robot: RobotModel, bounds: AccelerationRange | None = None
    ) -> list[Task]:
        """Return the tasks of a step: those given, or one that leads the arm.

        Args:
            tasks: that of the pose, if any, and that of the posture, last.
            robot: updated to the current state.
            bounds: that joints have for their own limits; None where they are not known.
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
            self._follow(robot.q, first.kp / first.kd, SHORT if goal.pose is not None else NEAR)
        elif self.progress is not Progress.NOT_HELD:
            self._watch_or_search(first, robot, goal, bounds)
        held = self._search is not None and self._hunted and self._ways.reached
        if self.progress is Progress.LED or held:
            follow = WayTask if self._closely else PostureTask
            return [follow(self.lead, first.kp, first.kd, first.weight)]
        if self._end is not None and posture is not first:
            return [first, replace(posture, q_des=self._end)]
        return tasks

    def _watch_or_search(
        self,
        task: PoseTask | PostureTask,
        robot: RobotModel,
        goal: Goal,
        bounds: AccelerationRange | None,
    ) -> None:
        """Search where the arm is stuck and its goal can be reached, until it moves on."""
        if self._search is not None and self._hunted:
            self._go_on()
            return
        watch = self._watch
        watch.look(task, robot)
        self._rest = max(self._rest - self._dt, 0.0)
        if self._search is None and self._rest == 0.0:
            if not watch.stuck:
                self.progress = Progress.NONE
            elif goal.pose is None and not self._ways.can_hold(goal.q):
                self.progress, self.load = Progress.NOT_HELD, np.abs(self._ways.load(goal.q))
            elif isinstance(task, PostureTask) and self._at_limit(task, robot.q, bounds):
                self.progress, self._rest = Progress.AT_LIMIT, PATIENCE
            else:
                self._begin(robot.q, goal)
        if self._search is not None:
            if watch.stands == 0.0 and not self._hunted:
                self.progress, self._search = Progress.NONE, None
            elif watch.stuck:
                self._go_on()

    def _at_limit(self, task: PostureTask, q: Array, bounds: AccelerationRange | None) -> bool:
        """Return whether each joint that is short of its goal is held by its own limit."""
        if bounds is None:
            return False
        error = task.q_des - q
        self.short = np.where(np.abs(error) > SHORT, np.abs(error), 0.0)
        towards = np.where(error > 0.0, bounds.upper, -bounds.lower)
        return bool((towards < GIVEN * task.kp * self.short)[self.short > 0.0].all())

    def _begin(self, q: Array, goal: Goal) -> None:
        """Begin to search."""
        # A seed for each attempt: the same motion each time, and another way each attempt.
        rng = np.random.default_rng(self._attempts)
        self._attempts += 1
        self.progress, self._time, self._work = Progress.SEARCHING, 0.0, 0.0
        self._hunted, self.lead = self._watch.hunts, q.copy()
        self._search = self._ways.ways(q.copy(), goal, rng)

    def _go_on(self) -> None:
        """Do a step's work of a search."""
        assert self._search is not None
        self._time += self._dt
        if self._hunted and self._time > _doubled(HELD, self._attempts - 1):
            self._search = None
            self._end_attempt()
            return
        self._work += WORK * self._dt
        try:
            while self._work > 0.0:
                self._work -= next(self._search)
        except StopIteration as found:
            self._search = None
            if found.value is None:
                self._end_attempt()
            else:
                self.progress, self._time = Progress.LED, 0.0
                self.lead, *self._left = found.value
                # A straight way that the arm did not follow is found again.
                self._closely = self._attempts > 1 and len(self._left) == 1

    def _end_attempt(self) -> None:
        """Look at the goal again; rest before another attempt if there have been many."""
        self._watch.reset()
        self.progress = Progress.NONE
        if self._attempts >= ATTEMPTS:
            self.progress = Progress.NO_WAY
            self._rest = min(_doubled(PATIENCE, self._attempts - ATTEMPTS), LONGEST_REST)

    def _follow(self, q: Array, rate: float, there: float) -> None:
        """Move the posture that leads, and see whether the arm comes with it.

        Args:
            q: positions, shape (n,), rad.
            rate: speed of the arm by its distance from that posture, 1/s.
            there: distance from the end of the way at which the arm need not come nearer, rad.
        """
        ahead = min(FARTHEST, PACE / rate)
        apart = float(np.abs(self.lead - q).max())
        self._time += self._dt
        waited = self._time > LONGEST + 4.0 / rate
        if not self._left and apart < (NEAR if waited else there):
            self._end = self.lead
            self._end_attempt()
        elif apart > LOST * ahead or waited:
            self._end_attempt()  # pushed away, or stuck again
        elif self._left and apart < ahead:
            if ahead - apart > 0.1 * PACE * self._dt:
                self._time = 0.0
            piece = self._left[0] - self.lead
            length = float(np.abs(piece).max())
            if length <= ahead - apart:
                self.lead = self._left.pop(0)
            else:
                self.lead = self.lead + (ahead - apart) / length * piece


def _doubled(time: float, times: int) -> float:
    return time * 2.0 ** min(times, DOUBLINGS)
