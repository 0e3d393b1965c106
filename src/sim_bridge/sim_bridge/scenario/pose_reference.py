"""Where a scenario wants the end effector, and how far it was from there."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from sim_bridge.bullet.client import pybullet
from sim_bridge.bullet.robot import BulletRobot
from sim_bridge.scenario.events import EnableTorque, Event, PoseGoal, TrajectoryGoal
from sim_bridge.scenario.pose_path import angle_between, sample
from sim_bridge.scenario.recording import Run

Array = NDArray[np.float64]


def pose_reference(events: Iterable[Event], t: Array) -> Array:
    """Return where the end effector is to be, as the scenario says, in the base frame.

    Compliance, on purpose, and collision avoidance may keep the arm from there.

    Args:
        events: in order of time.
        t: times, s, shape (N,).

    Returns:
        Position and quaternion x, y, z, w, shape (N, 7); NaN before the first pose or trajectory,
        and from a change to or from position control on until the next that comes under torque
        control.
    """
    reference = np.full((len(t), 7), np.nan)
    torque = True
    for event in events:
        now = np.flatnonzero(t >= event.time - 1e-9)
        if isinstance(event, EnableTorque):
            torque = event.enable
            reference[now] = np.nan
        elif torque and isinstance(event, PoseGoal):
            reference[now] = [*event.position, *event.orientation]
        elif torque and isinstance(event, TrajectoryGoal):
            for i in now:
                reference[i] = np.concatenate(sample(event.points, t[i] - event.time))
    return reference


def pose_errors(
    robot: BulletRobot, base_frame: str, frame: str, run: Run, reference: Array
) -> Array:
    """Return distance and angle to the reference, shape (N, 2), m and rad; NaN without one.

    Args:
        robot: moved through the recorded states.
        base_frame: frame that the reference is given in.
        frame: the end effector's.
        run: recorded states.
        reference: where it was to be, shape (N, 7), as from `pose_reference`.
    """
    errors = np.full((len(run.t), 2), np.nan)
    base = robot.link_pose(base_frame)
    rest = np.zeros(len(run.joints))
    for i in np.flatnonzero(np.isfinite(reference[:, 0])):
        robot.reset(run.q[i], rest)
        position, orientation = robot.link_pose(frame)
        wanted = pybullet.multiplyTransforms(*base, reference[i, :3], reference[i, 3:])
        errors[i] = math.dist(position, wanted[0]), angle_between(orientation, wanted[1])
    return errors
