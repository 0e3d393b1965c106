# SPDX-License-Identifier: Apache-2.0
"""The controller node's parameters: each declared once, and checked together."""

from torque_safety_controller.parameters.controller_parameters import ControllerConfiguration

__all__ = ["ControllerConfiguration"]
