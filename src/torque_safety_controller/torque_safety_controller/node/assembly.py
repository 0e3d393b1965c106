# SPDX-License-Identifier: Apache-2.0
"""Makes the controller from its configuration, and applies live changes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pinocchio as pin

from torque_safety_controller.additional_torque import AdditionalTorque
from torque_safety_controller.controller import Controller
from torque_safety_controller.parameters.collision_parameters import load_collision
from torque_safety_controller.parameters.controller_parameters import (
    ControllerConfiguration,
    load_robot,
)
from torque_safety_controller.parameters.interaction_parameters import make_interaction

if TYPE_CHECKING:
    from rclpy.node import Node


def make_controller(
    config: ControllerConfiguration, node: Node | None = None
) -> tuple[Controller, pin.SE3]:
    """Return a controller, warmed up, and the placement of the base frame.

    Args:
        config: checked parameters.
        node: listens for the URDF if it comes from a topic.

    Raises:
        SettingError: parameters that do not fit the URDF.
    """
    robot, base, urdf = load_robot(config, node)
    collision = load_collision(config.collision, config.robot, urdf, robot.model)
    controller = Controller(
        robot,
        config.tau_max,
        config.gains,
        config.tau_rate_max,
        AdditionalTorque(config.additional, config.task_rows),
        config.qp_solver,
        [] if collision is None else [collision],
        make_interaction(config.interaction, config.robot, robot, urdf),
    )
    controller.warm_up()
    return controller, base


def configure(controller: Controller, config: ControllerConfiguration) -> None:
    """Apply the live parameters to a running controller."""
    controller.gains = config.gains
    if controller.additional is not None:
        controller.additional.settings = config.additional
    if controller.interaction is not None:
        controller.interaction.settings = config.interaction.settings
        if controller.interaction.sensor is not None:
            controller.interaction.sensor.settings = config.interaction.sensor
