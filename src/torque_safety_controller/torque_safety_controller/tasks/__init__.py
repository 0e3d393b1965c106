# SPDX-License-Identifier: Apache-2.0
"""Tasks: what the accelerations should do, and the goals that they serve."""

from torque_safety_controller.tasks.gains import Gains
from torque_safety_controller.tasks.pose_task import PoseMotion, PoseTask
from torque_safety_controller.tasks.posture_task import PostureTask
from torque_safety_controller.tasks.task import RestTask, Task

__all__ = [
    "RestTask",
    "Gains",
    "PoseMotion",
    "PoseTask",
    "PostureTask",
    "Task",
]
