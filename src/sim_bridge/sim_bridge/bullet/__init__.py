# SPDX-License-Identifier: Apache-2.0
"""The simulated robot: PyBullet, drives, joint friction, sensors and obstacles."""

from sim_bridge.bullet.joint_friction import JointFriction
from sim_bridge.bullet.limit_monitor import LimitMonitor
from sim_bridge.bullet.obstacles import (
    Contact,
    ContactMaterial,
    LinkWrench,
    Obstacle,
    ObstacleError,
)
from sim_bridge.bullet.robot import BulletRobot, RobotState

__all__ = [
    "BulletRobot",
    "Contact",
    "ContactMaterial",
    "JointFriction",
    "LimitMonitor",
    "LinkWrench",
    "Obstacle",
    "ObstacleError",
    "RobotState",
]
