# SPDX-License-Identifier: Apache-2.0
"""Searches for ways to a posture or a pose that keep away from what cannot be held."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from torque_safety_controller.robot_model import RobotModel
from torque_safety_controller.tasks.posture_search import PostureSearch
from torque_safety_controller.tasks.way_search import CanPass, Search, Way, find_way

Array = NDArray[np.float64]

COMFORT = 0.1
"""Share of what postures may need that the middle of a way leaves: no arm follows it exactly."""

SLOPE = 0.24
"""Share of the torque limits that ways leave more with each rad from their ends, which may be what
can just be held: an arm at the edge of that cannot move along it, only away from it."""

ROUNDS = ((COMFORT, 60), (COMFORT, 300), (0.5 * COMFORT, 300), (0.0, 500))
"""What ways leave, and how many random postures are tried for each: first what is soon done."""

LOOSE = 0.2
"""How near its beginning a way may lead through what the model says cannot be held, where the arm
stands in spite of the model, rad."""

SEEDS, LOCAL, POSTURES = 40, 10, 5
"""In each round: from how many postures inverse kinematics begin, the first of them nearer to the
arm, and to how many of those that they find ways are searched for."""


class Goal(NamedTuple):
    """What an arm is brought to."""

    pose: pin.SE3 | None
    """Of the end effector, in the URDF's root frame; None for the joints alone."""
    q: Array
    """Of the joints, shape (n,), rad."""

    def same_as(self, other: Goal) -> bool:
        """Return whether all numbers are the same."""
        if self.pose is None or other.pose is None:
            same = self.pose is other.pose
        else:
            same = self.pose is other.pose or bool(self.pose == other.pose)
        return same and (self.q is other.q or np.array_equal(self.q, other.q))


class DetourSearch:
    """Finds ways for one arm.

    Args:
        robot: model of the arm.
        low: lowest positions of ways, shape (n,), rad; -inf for none.
        high: highest, shape (n,), rad; inf for none.
        tau_max: torques that postures may need, shape (n,), N m.
        can_hold: whether a posture can be held.

    Attributes:
        reached: whether the search that goes on knows a posture at the goal that can be held.
    """

    def __init__(
        self,
        robot: RobotModel,
        low: Array,
        high: Array,
        tau_max: Array,
        can_hold: Callable[[Array], bool],
    ) -> None:
        self.can_hold = can_hold
        self.reached = False
        self._low, self._high, self._tau_max = low, high, tau_max
        self._model, self._data = robot.model, robot.model.createData()
        self._kinematics = PostureSearch(robot.model, robot.frame, low, high)

    def load(self, q: Array) -> Array:
        """Return what holds a posture, as a share of the torques above, shape (n,)."""
        needed: Array = pin.computeGeneralizedGravity(self._model, self._data, q) / self._tau_max
        return needed

    def ways(self, q: Array, goal: Goal, rng: np.random.Generator) -> Search[Way | None]:
        """Search for a way from a posture to a goal; see `find_way`.

        For a pose, to the first posture that inverse kinematics and `find_way` find.

        Args:
            q: where the arm stands, shape (n,), rad.
            goal: for the joints, it can be held.
            rng: chooses the postures to try.
        """
        self.reached = goal.pose is None
        low = np.where(np.isfinite(self._low), self._low, q - np.pi)
        high = np.where(np.isfinite(self._high), self._high, q + np.pi)

        def find(end: Array, comfort: float, tries: int) -> Search[Way | None]:
            return find_way(q, end, low, high, self._can_pass(q, end, comfort), rng, tries)

        for comfort, tries in ROUNDS:
            if goal.pose is None:
                way = yield from find(goal.q, comfort, tries)
                if way is not None:
                    return way
                continue
            left = POSTURES
            for k in range(SEEDS):
                seed = q + min(k / LOCAL, 1.0) * (rng.uniform(low, high) - q)
                end = yield from self._kinematics.find(goal.pose, seed)
                if end is None or not self.can_hold(end):
                    continue
                self.reached = True
                way = yield from find(end, comfort, tries)
                if way is not None:
                    return way
                left -= 1
                if left == 0:
                    break
        return None

    def _can_pass(self, start: Array, end: Array, comfort: float) -> CanPass:
        """Return what tells where a way may lead."""
        loose = 0.0 if self.can_hold(start) else LOOSE
        at_start, at_end = (float(np.abs(self.load(q)).max()) for q in (start, end))

        def can_pass(q: Array) -> bool:
            from_start, from_end = (float(np.abs(q - each).max()) for each in (start, end))
            if from_start < loose:
                return True
            most = 1.0 - comfort
            if comfort > 0.0:
                most = max(most, at_start - SLOPE * from_start, at_end - SLOPE * from_end)
            return bool(np.abs(self.load(q)).max() <= most) and self.can_hold(q)

        return can_pass
