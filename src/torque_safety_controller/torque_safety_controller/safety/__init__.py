# SPDX-License-Identifier: Apache-2.0
"""Disturbances of the commanded accelerations."""

from torque_safety_controller.safety.disturbance_observer import DisturbanceObserver

__all__ = ["DisturbanceObserver"]
