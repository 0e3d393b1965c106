# SPDX-License-Identifier: Apache-2.0
"""For users of a controller that runs: a client for programs, the keyboard, MoveIt."""

from torque_safety_controller.remote.arm_client import ArmClient, ArmState, NotReachedError

__all__ = [
    "ArmClient",
    "ArmState",
    "NotReachedError",
]
