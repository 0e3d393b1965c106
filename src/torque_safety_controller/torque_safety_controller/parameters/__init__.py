# SPDX-License-Identifier: Apache-2.0
"""The controller node's parameters: tables, checks, and the configuration made of them."""

from torque_safety_controller.parameters.controller_parameters import (
    TABLE,
    ControllerConfiguration,
    load_robot,
    make_configuration,
)

__all__ = ["TABLE", "ControllerConfiguration", "load_robot", "make_configuration"]
