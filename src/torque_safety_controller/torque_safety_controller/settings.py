# SPDX-License-Identifier: Apache-2.0
"""What may change while a controller runs."""

from __future__ import annotations

from dataclasses import dataclass

from torque_safety_controller.friction.settings import FrictionSettings
from torque_safety_controller.integral_feedback.settings import IntegralSettings
from torque_safety_controller.tasks.admittance import InteractionSettings
from torque_safety_controller.tasks.gains import Gains


@dataclass(frozen=True)
class Settings:
    """Settings of a controller and its parts that are live.

    Attributes:
        gains: of the tasks.
        integral: of the integral action.
        friction: of the friction compensation.
        interaction: of forces at the hand.
    """

    gains: Gains
    integral: IntegralSettings
    friction: FrictionSettings
    interaction: InteractionSettings
