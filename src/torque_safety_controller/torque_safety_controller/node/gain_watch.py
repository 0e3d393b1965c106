# SPDX-License-Identifier: Apache-2.0
"""Warns of gains beyond what delay, motors and encoders permit, as far as they are declared."""

from __future__ import annotations

import threading

import pinocchio as pin
from rclpy.node import Node

from torque_safety_controller.loop_margins.arm_inertia import ArmInertia
from torque_safety_controller.node.declared import declared_robot
from torque_safety_controller.parameters.controller_parameters import ControllerConfiguration
from torque_safety_controller.parameters.loop_parameters import gain_check, limits_gains
from viability_bounds_pkg.node.bounds_parameters import BoundsConfiguration

_QUIET = 0.5
"""Time without a change of parameters after which gains are judged, s."""


class GainWatch:
    """Judges gains beside the control loop, in a thread: it takes some tenths of a second.

    They are judged when they have been the same for `_QUIET`: several threads would slow the loop.

    Where nothing is declared, nothing is judged as long as there is no integral action: with one
    whose gain is too high for the rate an arm passes all limits but those of its torques.

    Args:
        node: that warns.
        model: of the arm.
        config: of the controller.
    """

    def __init__(self, node: Node, model: pin.Model, config: ControllerConfiguration) -> None:
        self._log = node.get_logger()
        self._warned: set[tuple[str, float]] = set()
        self._robot, self._model = declared_robot(node), model
        self._inertia: ArmInertia | None = None
        self._judged: ControllerConfiguration | None = None
        self._timer: threading.Timer | None = None
        self.look(config)

    def look(self, config: ControllerConfiguration) -> None:
        """Judge the gains, at start and when they have changed."""
        self.close()
        if self._robot is None:
            return
        if limits_gains(self._robot.declared) or config.integral.integral_action != "none":
            self._judged = config
            self._timer = threading.Timer(_QUIET, self._judge, (self._robot, config))
            self._timer.daemon = True
            self._timer.start()

    def close(self) -> None:
        """Log no more warnings."""
        self._judged = None
        if self._timer is not None:
            self._timer.cancel()

    def _judge(self, robot: BoundsConfiguration, config: ControllerConfiguration) -> None:
        if self._inertia is None:
            self._inertia = ArmInertia.of(self._model, config.position_min, config.position_max)
        for limit in gain_check(config, robot, self._inertia).limits():
            if config is not self._judged:
                return  # the gains have changed again, or the node is gone
            key = limit.name, limit.value
            if limit.exceeded and key not in self._warned:
                self._warned.add(key)
                self._log.warning(str(limit))
