# SPDX-License-Identifier: Apache-2.0
"""A goal that moves, and a pose that follows a trajectory."""

from __future__ import annotations

from typing import Protocol

from torque_safety_controller.controller import Controller
from viability_bounds_pkg.pose_trajectory import PoseTrajectory
from viability_bounds_pkg.state import State


class Motion(Protocol):
    """Sets the controller's goal anew in each control step."""

    def advance(self, controller: Controller, state: State, stamp: int) -> bool:
        """Set the goal of one control step.

        Args:
            controller: is given the goal.
            state: of the joints now.
            stamp: of the state, ns.

        Returns:
            Whether the motion goes on; if not, the goal stays where it is.
        """


class TrajectoryMotion:
    """The end effector follows a trajectory.

    Args:
        trajectory: in the URDF's root frame.
        begin: its time 0, ns; 0 for the first step.
    """

    def __init__(self, trajectory: PoseTrajectory, begin: int) -> None:
        self._trajectory, self._begin = trajectory, begin

    def advance(self, controller: Controller, state: State, stamp: int) -> bool:
        """Set the goal of one control step; see `Motion`."""
        self._begin = self._begin or stamp
        t = 1e-9 * (stamp - self._begin)
        controller.set_pose_goal(*self._trajectory.sample(t))
        return t < self._trajectory.duration
