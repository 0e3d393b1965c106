# SPDX-License-Identifier: Apache-2.0
"""Goals of the end effector and the joints, and the tasks that bring the arm there."""

from __future__ import annotations

import math
import operator
from collections.abc import Sequence

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from torque_safety_controller.tasks.gains import Gains
from torque_safety_controller.tasks.pose_task import (
    OtherHandTask,
    PoseMotion,
    PoseTask,
    pose_error,
)
from torque_safety_controller.tasks.posture_task import PostureTask
from torque_safety_controller.tasks.task import Task

Array = NDArray[np.float64]


class Goals:
    """Poses of end effectors, a posture of the joints, or both.

    Args:
        n: number of joints.
        others: number of further end effectors.

    Attributes:
        pose_des: end-effector goal in the URDF's root frame; None until one is set.
        others: goals of the further end effectors, likewise.
        q_des: joint goal, shape (n,), rad; None until one is set.
        posture: what the null space is held at without a joint goal, shape (n,), rad.
        taken: how often the current pose was made the goal, by `hold`; a trajectory that was
            being followed has been overruled when it grows.
    """

    def __init__(self, n: int, others: int = 0) -> None:
        self.pose_des: pin.SE3 | None = None
        self.others: list[pin.SE3 | None] = [None] * others
        self.q_des: Array | None = None
        self.posture = np.zeros(n)
        self.taken = 0
        self._pose_motion: PoseMotion | None = None
        self._v_des: Array | None = None
        self._a_des: Array | None = None
        self._made: tuple[tuple[object, ...], list[Task]] | None = None

    @property
    def any(self) -> bool:
        """Whether there is something to track."""
        if self.pose_des is not None or self.q_des is not None:
            return True
        return any(pose is not None for pose in self.others)

    def set_pose(
        self,
        pose_des: pin.SE3,
        twist: Array | None = None,
        twist_rate: Array | None = None,
    ) -> None:
        """Move the end effector to `pose_des` in the URDF's root frame.

        Args:
            pose_des: goal now.
            twist: of a goal in motion, in the goal's axes, shape (6,), m/s and rad/s; None for
                one at rest.
            twist_rate: time derivative of `twist`, shape (6,); with `twist`.
        """
        self.pose_des = pose_des
        if twist is None or twist_rate is None:
            self._pose_motion = None
        else:
            self._pose_motion = PoseMotion(twist, twist_rate)

    def set_other_pose(self, hand: int, pose_des: pin.SE3) -> None:
        """Move a further end effector to `pose_des` in the URDF's root frame.

        Args:
            hand: its index in `RobotModel.others`.
            pose_des: goal at rest.
        """
        self.others = [*self.others[:hand], pose_des, *self.others[hand + 1 :]]

    def release_pose(self) -> None:
        """Leave end effectors without a goal, so that the joints' one counts in full."""
        self.pose_des = self._pose_motion = None
        self.others = [None] * len(self.others)

    def set_posture(
        self, q_des: Array, v_des: Array | None = None, a_des: Array | None = None
    ) -> None:
        """Bring the joints, or what the pose task leaves free of them, to `q_des`, rad.

        Args:
            q_des: goal now, shape (n,), rad.
            v_des: its velocity, shape (n,), rad/s; None for a goal at rest.
            a_des: its acceleration, shape (n,), rad/s^2; with `v_des`; None for zero.
        """
        self.q_des = q_des
        self._v_des, self._a_des = v_des, a_des

    def hold(self, pose: pin.SE3) -> None:
        """Take `pose`, where the end effector is, for the goal, whatever it was."""
        self.set_pose(pose.copy())
        self.taken += 1

    def hold_others(self, poses: Sequence[pin.SE3]) -> None:
        """Take `poses`, where the further end effectors are, for their goals."""
        self.others = [pose.copy() for pose in poses]

    def error(self, pose: pin.SE3) -> Array:
        """Return the error of the end effector's pose, shape (6,), m and rad, in its axes.

        NaN without a goal for the pose.
        """
        return np.full(6, math.nan) if self.pose_des is None else pose_error(pose, self.pose_des)

    def tasks(self, gains: Gains, stiffness: Array | None = None) -> list[Task]:
        """Return the pose task, if there is a goal for it, and the posture task.

        Args:
            gains: of the tasks.
            stiffness: share of `gains.pose_kp` in each of the end effector's axes, shape (6,);
                None for all of it.
        """
        made_of = (
            *(gains, stiffness, self.pose_des, self.others, self._pose_motion),
            *(self.q_des, self.posture, self._v_des, self._a_des),
        )
        # Mostly nothing has changed since the last step.
        if self._made is None or not all(map(operator.is_, made_of, self._made[0])):
            self._made = made_of, self._make_tasks(gains, stiffness)
        return self._made[1].copy()

    def _make_tasks(self, gains: Gains, stiffness: Array | None) -> list[Task]:
        tasks: list[Task] = []
        if gains.pose_weight > 0.0:
            if self.pose_des is not None:
                tasks.append(_pose_task(self.pose_des, gains, self._pose_motion, stiffness))
            tasks += [
                OtherHandTask(_pose_task(pose_des, gains), hand)
                for hand, pose_des in enumerate(self.others)
                if pose_des is not None
            ]
        tasks.append(
            PostureTask(
                self.posture if self.q_des is None else self.q_des,
                gains.posture_kp,
                gains.posture_kd,
                gains.posture_weight,
                bool(tasks) and self.pose_des is not None,
                self._posture_feedforward(gains),
                tuple(each.hand for each in tasks if isinstance(each, OtherHandTask)),
            )
        )
        return tasks

    def _posture_feedforward(self, gains: Gains) -> Array | None:
        if self._v_des is None:
            return None
        feedforward: Array = gains.posture_kd * self._v_des
        return feedforward if self._a_des is None else feedforward + self._a_des


def _pose_task(
    pose_des: pin.SE3,
    gains: Gains,
    motion: PoseMotion | None = None,
    stiffness: Array | None = None,
) -> PoseTask:
    return PoseTask(
        pose_des,
        gains.pose_kp,
        gains.pose_kd,
        gains.pose_weight,
        motion,
        stiffness,
        gains.pose_error_max,
        gains.pose_error == "separate",
    )
