# SPDX-License-Identifier: Apache-2.0
"""The whole-arm safety filter as a part."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from torque_safety_controller.parts.whole_arm.safety_filter import SafetyFilter
from torque_safety_controller.qp import AccelerationRange, LinearConstraints
from torque_safety_controller.robot_model import RobotModel
from torque_safety_controller.step import Part, Step, joints_beyond
from torque_safety_controller.tasks.rest_task import RestTask

Array = NDArray[np.float64]


class WholeArm(Part):
    """Lets only accelerations pass after which a plan to stop the whole arm is known.

    Args:
        safety_filter: keeps the plan in hand.
        robot: model of the arm.
        tau_max: torque limits, shape (n,), N m.
    """

    def __init__(self, safety_filter: SafetyFilter, robot: RobotModel, tau_max: Array) -> None:
        self.filter, self._robot, self._tau_max = safety_filter, robot, tau_max

    def reset(self, robot: RobotModel) -> None:
        """See `Part.reset`."""
        self.filter.reset()

    def prepare(self, step: Step) -> None:
        """Narrow the bounds, and add rows by which the plan keeps the torque limits."""
        keeper, robot, d = self.filter, step.robot, step.disturbance
        extra = step.torque - robot.M @ d
        rows = keeper.prepare(robot.q, robot.v, extra, *step.bounds)
        step.bounds = AccelerationRange(keeper.lower, keeper.upper)
        if rows is not None:
            free = np.full(len(rows.upper), -np.inf)
            step.rows[self] = LinearConstraints(rows.G, free, rows.upper)
        step.planned = not keeper.lost
        if keeper.lost:
            step.tasks, step.tracking = [RestTask(step.rest)], False
        else:
            step.fallback = keeper.plan

    def choose(self, step: Step, a: Array) -> Array:
        """Return `a`, or what of it leaves a plan."""
        return self.filter.choose(a + step.disturbance) - step.disturbance

    def report(self) -> dict[str, Any]:
        """See `Part.report`."""
        return {
            "steps_by_plan": self.filter.outcomes,
            "plan_torque_left": self.filter.slack,
            "joints_too_weak_to_hold": self._too_weak() or "none",
        }

    @property
    def trouble(self) -> str:
        """Which joints cannot hold the arm where it would come to rest."""
        weak = self._too_weak()
        return weak and f"the arm cannot be held where it would come to rest: {weak}"

    def _too_weak(self) -> str:
        return joints_beyond(self._robot, self.filter.rest_torque, self._tau_max)
