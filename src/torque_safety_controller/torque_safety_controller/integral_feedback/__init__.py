# SPDX-License-Identifier: Apache-2.0
"""Integral action: passive, leaky and limited."""

from torque_safety_controller.integral_feedback.joints import (
    InitialisationError,
    IntegralFeedback,
)
from torque_safety_controller.integral_feedback.law import ArmTerms, IntegralLaw
from torque_safety_controller.integral_feedback.leaky_integrator import LeakyIntegrator
from torque_safety_controller.integral_feedback.settings import (
    METHODS,
    MODES,
    TASKS,
    IntegralSettings,
)

__all__ = [
    "METHODS",
    "MODES",
    "TASKS",
    "ArmTerms",
    "InitialisationError",
    "IntegralFeedback",
    "IntegralLaw",
    "IntegralSettings",
    "LeakyIntegrator",
]
