# SPDX-License-Identifier: Apache-2.0
"""Disturbances: by how much the real accelerations differ from the commanded ones."""

from __future__ import annotations

from typing import TYPE_CHECKING

from torque_safety_controller.robot_model import RobotModel
from torque_safety_controller.safety.disturbance_observer import DisturbanceObserver
from torque_safety_controller.step import Part, Step

if TYPE_CHECKING:
    from torque_safety_controller.parameters.controller_parameters import ControllerConfiguration


class Disturbance(Part):
    """Tells later parts and the QP what disturbs the arm.

    Args:
        n: number of joints.
        time_constant: of the filter, s, >= 0.
    """

    def __init__(self, n: int, time_constant: float) -> None:
        self._observer = DisturbanceObserver(n, time_constant)

    def configure(self, config: ControllerConfiguration) -> None:
        """See `Part.configure`."""
        self._observer.time_constant = config.gains.disturbance_time

    def reset(self, robot: RobotModel) -> None:
        """See `Part.reset`."""
        self._observer.reset()

    def prepare(self, step: Step) -> None:
        """Estimate the disturbance by the step that has passed, and by what this one adds."""
        observer, robot = self._observer, step.robot
        if step.order.forget_disturbance:
            observer.reset()
        known = step.elapsed if step.learns else 0.0
        observer.observe(robot.v, step.a_last, known, step.tau_max, robot.M)
        observer.expect(step.integral_change, step.tau_max, robot.M)
        step.disturbance = observer.estimate

    def learn(self, step: Step) -> None:
        """Learn nothing from braking without a solution: motors may not give what it asks for."""
        if step.failure:
            self._observer.pause()
