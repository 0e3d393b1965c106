# SPDX-License-Identifier: Apache-2.0
"""Integral action: passive, leaky and limited; what every kind of it has in common."""

from torque_safety_controller.integral_feedback.action import ArmTerms, IntegralAction
from torque_safety_controller.integral_feedback.feedback import (
    InitialisationError,
    IntegralFeedback,
)
from torque_safety_controller.integral_feedback.leaky_integrator import LeakyIntegrator
from torque_safety_controller.integral_feedback.settings import METHODS, IntegralSettings

__all__ = [
    "METHODS",
    "ArmTerms",
    "InitialisationError",
    "IntegralAction",
    "IntegralFeedback",
    "IntegralSettings",
    "LeakyIntegrator",
]
