# SPDX-License-Identifier: Apache-2.0
"""Warns of gains beyond what delay, motors and encoders permit, as far as they are declared."""

from __future__ import annotations

import threading

import pinocchio as pin
from rclpy.node import Node

from torque_safety_controller.loop_margins.arm_inertia import ArmInertia
from torque_safety_controller.loop_margins.gain_check import GainCheck
from torque_safety_controller.node.declared import declared_robot
from torque_safety_controller.parameters.controller_parameters import ControllerConfiguration
from torque_safety_controller.parameters.loop_parameters import gain_check, limits_gains


class GainWatch:
    """Judges gains beside the control loop, in a thread: it takes some tenths of a second.

    Where nothing is declared, nothing is judged.

    Args:
        node: that warns.
        model: of the arm.
        config: of the controller.
    """

    def __init__(self, node: Node, model: pin.Model, config: ControllerConfiguration) -> None:
        self._log = node.get_logger()
        self._told: set[tuple[str, float]] = set()
        self._check: GainCheck | None = None
        self._inertia: ArmInertia | None = None
        robot = declared_robot(node)
        if robot is None:
            return
        self._robot = robot
        if limits_gains(self._robot.declared):
            self._inertia = ArmInertia.of(model, config.position_min, config.position_max)
            self.look(config)

    def look(self, config: ControllerConfiguration) -> None:
        """Judge the gains, at start and when they have changed."""
        if self._inertia is not None:
            self._check = gain_check(config, self._robot, self._inertia)
            threading.Thread(target=self._judge, args=(self._check,), daemon=True).start()

    def close(self) -> None:
        """Say nothing more."""
        self._check = None

    def _judge(self, check: GainCheck) -> None:
        for limit in check.limits():
            if check is not self._check:
                return  # the gains have changed again, or the node is gone
            key = limit.name, limit.value
            if limit.exceeded and key not in self._told:
                self._told.add(key)
                self._log.warning(str(limit))
