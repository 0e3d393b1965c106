"""Where an arm is to be, and the tasks that bring it there."""

from __future__ import annotations

import math

import numpy as np
import pinocchio as pin

from torque_safety_controller.robot_model import RobotModel
from torque_safety_controller.tasks.gains import Gains
from torque_safety_controller.tasks.tasks import (
    TaskTerm,
    pose_error,
    pose_feed_forward,
    pose_task,
    posture_task,
)


class Goals:
    """A pose of the end effector, a posture of the joints, or both.

    Attributes:
        pose_des: end-effector goal in the URDF's root frame; None until one is set.
        q_des: joint goal, shape (n,), rad; None until one is set.
        posture: what the null space is held at without a joint goal, shape (n,), rad.
        error: of the pose goal in the last step, shape (6,), m and rad, in the end effector's
            axes.
        taken: how often the arm has taken the pose where it was for its goal, by `hold`; what
            follows a plan of its own has been overruled when it grows.
    """

    def __init__(self, n: int) -> None:
        self.pose_des: pin.SE3 | None = None
        self.q_des: np.ndarray | None = None
        self.posture = np.zeros(n)
        self.error = np.full(6, math.nan)
        self.taken = 0
        self._pose_motion: tuple[np.ndarray, np.ndarray] | None = None
        self._v_des: np.ndarray | None = None

    @property
    def any(self) -> bool:
        """Whether there is something to track."""
        return self.pose_des is not None or self.q_des is not None

    def set_pose(
        self,
        pose_des: pin.SE3,
        twist: np.ndarray | None = None,
        twist_rate: np.ndarray | None = None,
    ) -> None:
        """Move the end effector to `pose_des` in the URDF's root frame.

        Args:
            pose_des: goal now.
            twist: of a goal in motion, in the goal's axes, shape (6,), m/s and rad/s; None for
                one at rest.
            twist_rate: time derivative of `twist`, shape (6,); with `twist`.
        """
        self.pose_des = pose_des
        self._pose_motion = None if twist is None else (twist, twist_rate)

    def set_posture(self, q_des: np.ndarray, v_des: np.ndarray | None = None) -> None:
        """Bring the joints, or what the pose task leaves free of them, to `q_des`, rad.

        Args:
            q_des: goal now, shape (n,), rad.
            v_des: its velocity, shape (n,), rad/s; None for a goal at rest.
        """
        self.q_des = q_des
        self._v_des = v_des

    def hold(self, pose: pin.SE3) -> None:
        """Take `pose`, where the end effector is, for the goal, whatever it was."""
        self.set_pose(pose.copy())
        self.taken += 1

    def tasks(
        self,
        robot: RobotModel,
        q: np.ndarray,
        v: np.ndarray,
        gains: Gains,
        stiffness: np.ndarray | None = None,
    ) -> list[TaskTerm]:
        """Return the pose task, if there is a goal for it, and the posture task.

        Args:
            robot: updated to the current state.
            q: position, shape (n,), rad.
            v: velocity, shape (n,), rad/s.
            gains: of the tasks.
            stiffness: share of `gains.pose_kp` in each of the end effector's axes, shape (6,);
                None for all of it.
        """
        tasks = []
        if self.pose_des is not None:
            self.error = error = pose_error(robot.pose, self.pose_des)
            if stiffness is not None:
                error = stiffness * error
            if gains.pose_weight > 0.0:
                kp, kd, weight = gains.pose_kp, gains.pose_kd, gains.pose_weight
                tasks.append(pose_task(robot, v, error, kp, kd, weight, self._ahead(robot, v, kd)))
        tasks.append(
            posture_task(
                self.posture if self.q_des is None else self.q_des,
                q,
                v,
                gains.posture_kp,
                gains.posture_kd,
                gains.posture_weight,
                robot.J if tasks and gains.posture_in_null_space else None,
                None if self._v_des is None else gains.posture_kd * self._v_des,
            )
        )
        return tasks

    def _ahead(self, robot: RobotModel, v: np.ndarray, kd: float) -> np.ndarray | None:
        if self._pose_motion is None:
            return None
        return pose_feed_forward(robot, v, self.pose_des, *self._pose_motion, kd)
