# SPDX-License-Identifier: Apache-2.0
"""Slows the arm: it serves its goals by a share, and the rest of its accelerations brake it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from torque_safety_controller.qp import AccelerationRange, TaskTerm
from torque_safety_controller.robot_model import RobotModel
from torque_safety_controller.step import Part, Step
from torque_safety_controller.tasks.task import Task

Array = NDArray[np.float64]

STOP_TIME = 0.02
"""Time constant by which a joint within its margins stops that moves on towards a limit, s."""

LATE_PERIODS = 3
"""Periods that a command of a joint near its limit may come late."""

_UNBOUNDED = 1e6
"""Stands for the width of bounds that are infinite, rad/s^2."""


class SlowDown(Part):
    """Blends tasks and bounds towards rest while the arm may serve its goals by a share only.

    Args:
        position_min: lower position limits without margins, shape (n,), rad.
        position_max: upper ones, shape (n,), rad.
        period: of control, s.
        without_jolts: whether the bounds demand none, as their jerk is limited.
    """

    def __init__(
        self,
        position_min: Array,
        position_max: Array,
        period: float,
        without_jolts: bool = False,
    ) -> None:
        self._without_jolts = without_jolts
        self._position_limits, self._period = (position_min, position_max), period

    def prepare(self, step: Step) -> None:
        """Let tasks ask for their share, and wish for bounds around rest."""
        share, robot = step.order.share, step.robot
        if share >= 1.0:
            return
        if step.fallback is None and not self._without_jolts:
            step.bounds = self.return_bounds(step.bounds, robot.q, robot.v, share)
        step.tasks = [SharedTask(task, step.rest, share) for task in step.tasks]
        step.eased = bounds_near(step.rest, step.commanded(step.bounds), share)

    def return_bounds(
        self, bounds: AccelerationRange, q: Array, v: Array, share: float
    ) -> AccelerationRange:
        """Return bounds by which a joint within the margins of a limit returns by a share only.

        The bounds of such a joint demand to be back after two periods: a jolt for an arm that was
        stopped there. Here they demand the share of it, and of a joint that moves on towards
        its limit to brake by

            max(|v| / `STOP_TIME`, v^2 / (r - 2 `LATE_PERIODS` h |v|)),

        r the room to the limit and h the period, so that it stops in less than half of the room
        even where commands are late; never more than the bounds themselves demand.

        Args:
            bounds: of the accelerations, shape (n,) each, rad/s^2.
            q: position, shape (n,), rad.
            v: velocity, shape (n,), rad/s.
            share: from 0 to 1.
        """
        lower, upper = bounds
        low, high = self._position_limits
        speed = np.abs(v)
        room = np.where(v > 0.0, high - q, q - low) - 2.0 * LATE_PERIODS * self._period * speed
        with np.errstate(divide="ignore", invalid="ignore"):
            brake = np.where(room > 0.0, np.maximum(speed / STOP_TIME, v * v / room), np.inf)
            # Bounds may be infinite where there are none.
            inward = np.maximum(share * lower, np.where(v < 0.0, brake, 0.0))
            outward = np.minimum(share * upper, np.where(v > 0.0, -brake, 0.0))
        return AccelerationRange(
            np.where(lower > 0.0, np.minimum(inward, lower), lower),
            np.where(upper < 0.0, np.maximum(outward, upper), upper),
        )


@dataclass(slots=True)
class SharedTask:
    """A task that is served by a share; the rest of what it asks for brings the arm to rest.

    Attributes:
        task: that is shared.
        rest: accelerations that bring the arm to rest, shape (n,), rad/s^2.
        share: from 0 to 1.
    """

    task: Task
    rest: Array
    share: float

    def term(self, robot: RobotModel) -> TaskTerm:
        """Return ``share b + (1 - share) A rest`` in place of the task's b."""
        return self.task.term(robot).mixed(self.rest, self.share)


def bounds_near(rest: Array, bounds: AccelerationRange, share: float) -> AccelerationRange:
    """Return the share of the bounds that is nearest to coming to rest.

    A goal that is far away asks for far more than the bounds allow: a small share of it, too.

    Args:
        rest: accelerations that bring the arm to rest, shape (n,), rad/s^2.
        bounds: of the accelerations, shape (n,) each, rad/s^2.
        share: from 0 to 1.
    """
    lower, upper = bounds
    near = np.minimum(np.maximum(rest, lower), upper)
    reach = share * np.minimum(upper - lower, _UNBOUNDED)
    return AccelerationRange(np.maximum(lower, near - reach), np.minimum(upper, near + reach))
