# SPDX-License-Identifier: Apache-2.0
"""Largest gains of a robot: its loops with delay, motor lag and estimated states; no ROS."""

from torque_safety_controller.loop_margins.arm_inertia import ArmInertia
from torque_safety_controller.loop_margins.gain_check import (
    GainCheck,
    GainLimit,
    GainSettings,
    RobotTiming,
)

__all__ = [
    "ArmInertia",
    "GainCheck",
    "GainLimit",
    "GainSettings",
    "RobotTiming",
]
