# SPDX-License-Identifier: Apache-2.0
"""Goals that move: jogs of the hand and of the joints, trajectories; no ROS."""

from torque_safety_controller.driving.execution import Execution, Progress, Tolerances
from torque_safety_controller.driving.jog import HandJog, JointJog
from torque_safety_controller.driving.joint_trajectory import (
    JointMotion,
    JointPoint,
    JointTrajectory,
    JointTrajectoryError,
)
from torque_safety_controller.driving.motion import Motion, TrajectoryMotion

__all__ = [
    "Execution",
    "HandJog",
    "JointJog",
    "JointMotion",
    "JointPoint",
    "JointTrajectory",
    "JointTrajectoryError",
    "Motion",
    "Progress",
    "Tolerances",
    "TrajectoryMotion",
]
