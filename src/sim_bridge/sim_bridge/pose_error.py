"""How far the end effector was from its goals, by PyBullet's forward kinematics."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from sim_bridge.bullet_robot import BulletRobot
from sim_bridge.quiet_pybullet import pybullet
from sim_bridge.recording import Run
from sim_bridge.scenario import PoseGoal


def pose_errors(
    robot: BulletRobot, base_frame: str, frame: str, run: Run, goals: Sequence[PoseGoal]
) -> np.ndarray:
    """Return distance and angle to the goal of the time, shape (N, 2), m and rad.

    Args:
        robot: moved through the recorded states.
        base_frame: frame that goals are given in.
        frame: the end effector's.
        run: recorded states.
        goals: in order of time; before the first, errors are NaN.
    """
    errors = np.full((len(run.t), 2), np.nan)
    base = robot.link_pose(base_frame)
    wanted = [
        (goal.time, pybullet.multiplyTransforms(*base, goal.position, goal.orientation))
        for goal in goals
    ]
    rest = np.zeros(len(run.joints))
    for i, t in enumerate(run.t):
        due = [pose for time, pose in wanted if time <= t + 1e-9]
        if not due:
            continue
        robot.reset(run.q[i], rest)
        position, orientation = robot.link_pose(frame)
        goal_position, goal_orientation = due[-1]
        errors[i, 0] = math.dist(position, goal_position)
        errors[i, 1] = _angle(orientation, goal_orientation)
    return errors


def _angle(a: Sequence[float], b: Sequence[float]) -> float:
    """Return the angle between two orientations, quaternions x, y, z, w, in rad."""
    difference = pybullet.getDifferenceQuaternion(a, b)
    return 2.0 * math.atan2(math.hypot(*difference[:3]), abs(difference[3]))
