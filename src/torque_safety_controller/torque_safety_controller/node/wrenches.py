# SPDX-License-Identifier: Apache-2.0
"""Wrenches from messages: measured ones, and those that the arm is to exert."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from functools import partial

import numpy as np
import pinocchio as pin
from geometry_msgs.msg import WrenchStamped
from numpy.typing import NDArray
from std_srvs.srv import Trigger

from torque_safety_controller.node.goal_messages import GoalRefused, check_frame
from torque_safety_controller.node.topics import TARE_FT_SENSOR, TARGET_WRENCH
from torque_safety_controller.node.waiting_goals import WaitingGoals
from torque_safety_controller.parameters.controller_parameters import ControllerConfiguration
from torque_safety_controller.parts.contact.interaction import Compliance, Interaction
from torque_safety_controller.parts.contact.wrench_sensor import (
    STRONGEST,
    WrenchError,
    WrenchSensor,
)
from viability_bounds_pkg.ros.arm_node import ArmNode
from viability_bounds_pkg.ros.messages import wrench_numbers
from viability_bounds_pkg.ros.runtime import stamp_to_ns, steady_timer
from viability_bounds_pkg.ros.topics import FT_WRENCH

Array = NDArray[np.float64]

_PERIOD = 0.5
"""Between two looks for the publisher of a target, s."""


class WrenchSubscriber:
    """Subscribes to ``ft_wrench`` and ``target_wrench``; serves ``~/tare_ft_sensor``.

    A target ends when nobody publishes ``target_wrench`` any more.

    Args:
        node: listens and logs what is refused.
        interaction: receives measurements and targets; None for an arm that handles no forces.
        goals: keeps targets until they are due.
        config: names the frames.
        base: placement of the base frame in the URDF's root frame.

    Attributes:
        refused: measurements that could not be used, by reason.
    """

    def __init__(
        self,
        node: ArmNode,
        interaction: Interaction | None,
        goals: WaitingGoals,
        config: ControllerConfiguration,
        base: pin.SE3,
    ) -> None:
        self._interaction, self._goals, self._config = interaction, goals, config
        self._base = base
        self._logger = node.get_logger()
        self.refused: Counter[str] = Counter()
        self._changes = 0
        self._measured_at = 0  # stamp of the last measurement, ns
        goals.listen(TARGET_WRENCH, self._on_target)
        if interaction is None:
            return
        sensor = interaction.sensor
        node.listen(FT_WRENCH, partial(self._on_measured, sensor))
        count = partial(node.count_publishers, TARGET_WRENCH.name)
        steady_timer(node, _PERIOD, partial(self._watch, interaction, count))
        TARE_FT_SENSOR.serve(node, partial(self._on_tare, interaction, sensor))

    def _on_measured(self, sensor: WrenchSensor, message: WrenchStamped) -> None:
        stamp = stamp_to_ns(message.header.stamp)
        if stamp and stamp == self._measured_at:
            return  # a driver repeats what it has; the sensor may be silent
        self._measured_at = stamp
        try:
            check_frame(message.header.frame_id, self._config.interaction.ft_frame)
            sensor.receive(wrench_numbers(message))
        except GoalRefused as error:
            # Counted together, whatever the frame: senders do not make the report longer.
            self._refuse("another frame_id", str(error))
        except WrenchError as error:
            self._refuse(str(error), str(error))

    def _refuse(self, reason: str, detail: str) -> None:
        self.refused[reason] += 1
        if self.refused[reason] == 1:
            self._logger.warning(f"ft_wrench refused: {detail}")

    def _on_target(self, message: WrenchStamped) -> None:
        config, interaction = self._config, self._interaction
        if interaction is None:
            raise GoalRefused("there is no force/torque sensor, 'ft_frame'")
        wrench = wrench_numbers(message)
        if not np.isfinite(wrench).all():
            raise GoalRefused("wrench is not finite")
        if (strong := np.abs(wrench).max()) > STRONGEST:
            raise GoalRefused(f"wrench has {strong:g}; allowed: up to {STRONGEST:g} N or N m")
        frame = message.header.frame_id
        check_frame(frame, config.end_effectors[0], config.base_frame)
        rotation = self._base.rotation if frame == config.base_frame else None
        apply = partial(self._apply, interaction, wrench, rotation)
        self._goals.add(TARGET_WRENCH, message, apply)

    def _apply(self, interaction: Interaction, wrench: Array, rotation: Array | None) -> None:
        if not interaction.settings.force_directions.any():
            raise GoalRefused("no direction of 'force_directions' is set")
        interaction.set_target(wrench, rotation)

    def _watch(self, interaction: Interaction, count: Callable[[], int]) -> None:
        """End a wrench whose publisher has gone."""
        if interaction.has_target and not count():
            interaction.end_target()
            self._logger.warning("target_wrench ends: its publisher has gone")

    def _on_tare(
        self,
        interaction: Interaction,
        sensor: WrenchSensor,
        _: Trigger.Request,
        response: Trigger.Response,
    ) -> Trigger.Response:
        if interaction.state in (Compliance.FORCE, Compliance.YIELDING):
            response.message = "refused: the hand is in contact"
            return response
        try:
            bias = sensor.tare()
        except WrenchError as error:
            response.message = f"refused: {error}"
            return response
        response.success = True
        response.message = f"bias: {np.array2string(bias, precision=3)}"
        return response

    def log_changes(self) -> None:
        """Log a change of the compliance state."""
        interaction = self._interaction
        if interaction is None or interaction.changes == self._changes:
            return
        self._changes = interaction.changes
        text = f"compliance: {interaction.state.value} ({interaction.reason})"
        # One call site per severity: rclpy ties the two together.
        if interaction.state is Compliance.SILENT:
            self._logger.warning(text)
        else:
            self._logger.info(text)
