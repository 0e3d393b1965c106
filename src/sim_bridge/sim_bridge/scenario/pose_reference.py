# SPDX-License-Identifier: Apache-2.0
"""The reference of the end effector in a scenario, and the distance of a recorded run from it."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from sim_bridge.bullet.robot import BulletRobot
from sim_bridge.scenario.events import EnableTorque, Event, PoseGoal, TrajectoryGoal
from sim_bridge.scenario.recording import RecordedRun

Array = NDArray[np.float64]


def pose_reference(events: Iterable[Event], t: Array) -> Array:
    """Return the pose that the scenario asks of the end effector, in the base frame.

    The end effector of a compliant arm, or of one that avoids collisions, may be elsewhere.

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
                reference[i] = pin.SE3ToXYZQUAT(event.trajectory.sample(t[i] - event.time)[0])
    return reference


def pose_errors(
    robot: BulletRobot, base_frame: str, frame: str, run: RecordedRun, reference: Array
) -> Array:
    """Return distance and angle to the reference, shape (N, 2), m and rad; NaN without one.

    Args:
        robot: set to the recorded states.
        base_frame: frame that the reference is given in.
        frame: the end effector's.
        run: recorded states.
        reference: shape (N, 7), of `pose_reference`.
    """
    errors = np.full((len(run.t), 2), np.nan)
    base = robot.link_pose(base_frame)
    rest = np.zeros(len(run.joints))
    for i in np.flatnonzero(np.isfinite(reference[:, 0])):
        robot.reset(run.q[i], rest)
        pose, desired = robot.link_pose(frame), base * pin.XYZQUATToSE3(reference[i])
        turn = pin.log3(pose.rotation.T @ desired.rotation)
        errors[i] = np.linalg.norm(desired.translation - pose.translation), np.linalg.norm(turn)
    return errors
