# SPDX-License-Identifier: Apache-2.0
"""Goals of the end effectors and the joints, and the tasks that bring the arm there."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from torque_safety_controller.robot_model import RobotModel
from torque_safety_controller.step import Part, Settings, Step, too_weak_at
from torque_safety_controller.tasks.gains import Gains
from torque_safety_controller.tasks.pose_task import (
    PoseMotion,
    PoseTask,
    pose_error,
)
from torque_safety_controller.tasks.posture_task import PostureTask
from torque_safety_controller.tasks.task import RestTask, Task

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Targets:
    """Where the arm is to go: poses of end effectors, a posture of the joints, or both.

    Attributes:
        pose: of the end effector in the URDF's root frame; None for no goal.
        motion: of that pose; None for one at rest.
        others: poses of the further end effectors, likewise.
        q: of the joints, shape (n,), rad; None for no goal.
        v: velocity of `q`, shape (n,), rad/s; None for a goal at rest.
        a: its acceleration, shape (n,), rad/s^2; with `v`; None for zero.
    """

    pose: pin.SE3 | None = None
    motion: PoseMotion | None = None
    others: tuple[pin.SE3 | None, ...] = ()
    q: Array | None = None
    v: Array | None = None
    a: Array | None = None


class Goals(Part):
    """Serves the goals of an arm, or brings it to rest where there are none.

    Args:
        n: number of joints.
        gains: of the tasks.
        others: number of further end effectors.

    Attributes:
        targets: where the arm is to go; may be replaced between steps.
        gains: of the tasks.
        posture: what the null space is held at without a joint goal, shape (n,), rad.
        held: how often the current pose was made the goal, by `hold`; a trajectory that was
            being followed has been overruled when it grows.
    """

    def __init__(self, n: int, gains: Gains, others: int = 0) -> None:
        self.targets = Targets(others=(None,) * others)
        self.gains = gains
        self.posture = np.zeros(n)
        self.held = 0
        self._tasks: list[Task] = []
        self._made_of: tuple[object, ...] = (None,) * 4
        self._trouble = ""

    # Set from outside

    @property
    def any(self) -> bool:
        """Whether there is something to track."""
        goals = self.targets
        if goals.pose is not None or goals.q is not None:
            return True
        return any(other is not None for other in goals.others)

    @property
    def pose_des(self) -> pin.SE3 | None:
        """End-effector goal in the URDF's root frame; None until one is set."""
        return self.targets.pose

    @property
    def q_des(self) -> Array | None:
        """Joint goal, shape (n,), rad; None until one is set."""
        return self.targets.q

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
        motion = None
        if twist is not None and twist_rate is not None:
            motion = PoseMotion(twist, twist_rate)
        self.targets = replace(self.targets, pose=pose_des, motion=motion)

    def set_other_pose(self, hand: int, pose_des: pin.SE3) -> None:
        """Move a further end effector to `pose_des` in the URDF's root frame.

        Args:
            hand: its index in `RobotModel.others`.
            pose_des: goal at rest.
        """
        others = list(self.targets.others)
        others[hand] = pose_des
        self.targets = replace(self.targets, others=tuple(others))

    def set_posture(
        self, q_des: Array, v_des: Array | None = None, a_des: Array | None = None
    ) -> None:
        """Bring the joints, or what the pose task leaves free of them, to `q_des`, rad.

        Args:
            q_des: goal now, shape (n,), rad.
            v_des: its velocity, shape (n,), rad/s; None for a goal at rest.
            a_des: its acceleration, shape (n,), rad/s^2; with `v_des`; None for zero.
        """
        self.targets = replace(self.targets, q=q_des, v=v_des, a=a_des)

    def move_poses(self, motion: pin.SE3) -> None:
        """Move the poses of end effectors with the frame that they are given in.

        Args:
            motion: of that frame, in the URDF's root frame.
        """
        pose, *others = (
            each and motion * each for each in (self.targets.pose, *self.targets.others)
        )
        self.targets = replace(self.targets, pose=pose, others=tuple(others))

    def release_pose(self) -> None:
        """Leave end effectors without a goal, so that the joints' one counts in full."""
        others = (None,) * len(self.targets.others)
        self.targets = replace(self.targets, pose=None, motion=None, others=others)

    def come_to_rest(self) -> None:
        """Leave the goals where they are; none moves any more."""
        self.targets = replace(self.targets, motion=None, v=None, a=None)

    def hold(self, pose: pin.SE3) -> None:
        """Make `pose`, where the end effector is, the goal, whatever it was."""
        self.set_pose(pose.copy())
        self.held += 1

    def hold_here(self, robot: RobotModel) -> None:
        """Make the poses and the posture of the arm its goals."""
        others = tuple(hand.pose.copy() for hand in robot.others)
        self.targets = Targets(robot.pose.copy(), None, others, robot.q.copy())
        self.posture = robot.q.copy()
        self.held += 1

    def error(self, pose: pin.SE3) -> Array:
        """Return the error of the end effector's pose, shape (6,), m and rad, in its axes.

        NaN without a goal for the pose.
        """
        return np.full(6, math.nan) if self.pose_des is None else pose_error(pose, self.pose_des)

    # As a part

    def configure(self, settings: Settings) -> None:
        """See `Part.configure`."""
        self.gains = settings.gains

    def reset(self, robot: RobotModel) -> None:
        """Keep the goals; where the arm is, the null space is held."""
        self.posture = robot.q.copy()

    def remodel(self, robot: RobotModel) -> None:
        """Look again whether the arm can be held at its goal."""
        self._made_of = (None,) * 4

    def prepare(self, step: Step) -> None:
        """Add the tasks of the goals, or damping without any."""
        step.tracking = step.order.track and self.any
        if step.tracking:
            if self.targets is not self._made_of[0]:
                self._trouble = self._too_heavy(step)
            step.tasks += self.tasks(step.stiffness)
        else:
            step.tasks = [RestTask(step.rest)]

    @property
    def trouble(self) -> str:
        """Which joints cannot hold the arm at the joints' goal."""
        return self._trouble

    def _too_heavy(self, step: Step) -> str:
        robot, goals = step.robot, self.targets
        if goals.q is None or goals.pose is not None or goals.v is not None:
            return ""
        heavy = too_weak_at(robot.model, goals.q, step.tau_max)
        return heavy and f"the goal cannot be held: {heavy}"

    def tasks(self, stiffness: Array | None) -> list[Task]:
        """Return the tasks that serve the goals.

        Args:
            stiffness: factors of the pose task's gains, shape (6,); None for ones.
        """
        targets, gains, posture, shares = self._made_of
        # Mostly nothing has changed since the last step.
        if not (
            targets is self.targets
            and gains is self.gains
            and posture is self.posture
            and shares is stiffness
        ):
            self._made_of = self.targets, self.gains, self.posture, stiffness
            self._tasks = self._make_tasks(stiffness)
        return self._tasks

    def _make_tasks(self, stiffness: Array | None) -> list[Task]:
        goals, gains = self.targets, self.gains
        hands: list[PoseTask] = []
        if gains.pose_weight > 0.0:
            if goals.pose is not None:
                hands.append(_pose_task(goals.pose, gains, goals.motion, stiffness))
            hands += [
                _pose_task(pose, gains, hand=hand)
                for hand, pose in enumerate(goals.others)
                if pose is not None
            ]
        feedforward = None
        if goals.v is not None:
            feedforward = gains.posture_kd * goals.v
            if goals.a is not None:
                feedforward = feedforward + goals.a
        posture = PostureTask(
            self.posture if goals.q is None else goals.q,
            gains.posture_kp,
            gains.posture_kd,
            gains.posture_weight,
            any(each.hand is None for each in hands),
            feedforward,
            tuple(each.hand for each in hands if each.hand is not None),
        )
        return [*hands, posture]


def _pose_task(
    pose_des: pin.SE3,
    gains: Gains,
    motion: PoseMotion | None = None,
    stiffness: Array | None = None,
    hand: int | None = None,
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
        hand,
    )
