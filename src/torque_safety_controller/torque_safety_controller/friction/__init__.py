# SPDX-License-Identifier: Apache-2.0
"""Joint friction: its model and identification."""

from torque_safety_controller.friction.identification import JointFit, friction_model, identify
from torque_safety_controller.friction.joint_recording import RecordingError, load_recording
from torque_safety_controller.friction.settings import FrictionModel, FrictionSettings

__all__ = [
    "FrictionModel",
    "FrictionSettings",
    "JointFit",
    "RecordingError",
    "friction_model",
    "identify",
    "load_recording",
]
