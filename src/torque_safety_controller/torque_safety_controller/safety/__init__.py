# SPDX-License-Identifier: Apache-2.0
"""Last checks of a torque, disturbances, modes, handover, and how a slowed arm goes on."""

from torque_safety_controller.safety.command_watch import CommandWatch
from torque_safety_controller.safety.disturbance_observer import DisturbanceObserver
from torque_safety_controller.safety.handover import Control, Handover, HandoverRefused
from torque_safety_controller.safety.modes import Mode, ModeKeeper
from torque_safety_controller.safety.rate_watch import RateWatch
from torque_safety_controller.safety.torque_limiter import TorqueLimiter

__all__ = [
    "CommandWatch",
    "Control",
    "DisturbanceObserver",
    "Handover",
    "HandoverRefused",
    "Mode",
    "ModeKeeper",
    "RateWatch",
    "TorqueLimiter",
]
