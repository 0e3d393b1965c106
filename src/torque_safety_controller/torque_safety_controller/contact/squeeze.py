# SPDX-License-Identifier: Apache-2.0
"""Two hands hold one object: the force that they press it together with, and its load, apart.

[Benallegue2021], III-E, says that (27) is to be projected where two links are controlled in force,
and not how. `docs/forces.md` derives what is done here. With x the unit vector from the first hand
to the second, and f_1, f_2 the object's forces on the hands,

    P = x . (f_2 - f_1) / 2,    s = x . (v_1 - v_2)

are the squeeze, which is internal, and the speed at which the hands approach each other: the
object's motion takes no work from P, and s none from its load f_1 + f_2. (27) acts on s alone:

    s' = -Kp (P - P_ref) - Kv (P' - P_ref') - kd s.

All other directions of both hands keep the stiffness of their poses, also that in which the load
moves both.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from torque_safety_controller.contact.admittance import AdmittanceGains
from torque_safety_controller.contact.interaction import FORCE_STEP, WRENCH_TIME, WRENCH_WEIGHT
from torque_safety_controller.contact.wrench_sensor import WrenchSensor
from torque_safety_controller.qp.inverse_dynamics_qp import ContactForces
from torque_safety_controller.qp.terms import TaskTerm, WrenchTerm
from torque_safety_controller.robot_model import RobotModel
from torque_safety_controller.tasks.gains import Gains
from torque_safety_controller.tasks.goals import Goals
from torque_safety_controller.tasks.pose_task import OtherHandTask, PoseTask
from torque_safety_controller.tasks.task import Task

Array = NDArray[np.float64]


def closing_direction(robot: RobotModel) -> Array:
    """Return d with d . (twists of both hands, each in its own axes) = s, shape (12,)."""
    first, second = robot.pose, robot.others[0].pose
    apart = second.translation - first.translation
    x = apart / max(math.sqrt(apart @ apart), 1e-9)
    direction = np.zeros(12)
    direction[:3], direction[6:9] = first.rotation.T @ x, -second.rotation.T @ x
    return direction


@dataclass(slots=True)
class SqueezeTask:
    """The pose tasks of two hands, with (27) in place of the stiffness along their line.

    Attributes:
        first: of the first hand.
        second: of the second one.
        closing: acceleration of (27) with which they approach, m/s^2.
    """

    first: PoseTask
    second: PoseTask
    closing: float

    def term(self, robot: RobotModel) -> TaskTerm:
        """Return the term for both hands: 12 rows."""
        hands = (self.first, robot), (self.second, robot.others[0])
        terms = [task.term(hand) for task, hand in hands]
        free = [replace(task, kp=0.0).term(hand) for task, hand in hands]
        A = np.vstack([robot.J, robot.others[0].J])
        b = np.concatenate([each.b for each in terms])
        stiffness = b - np.concatenate([each.b for each in free])
        d = closing_direction(robot)
        # d . b is s', less what the axes and J' add, of which free.b has all.
        b += d * ((self.closing - d @ stiffness) / (d @ d))
        return TaskTerm(A, b, self.first.weight)


class Squeeze:
    """Presses an object between two hands with a given force.

    Args:
        sensors: at both hands.
        gains: of (27) for the force along the line between the hands.

    Attributes:
        target: force to press with, N; None while nothing is pressed.
        force: that is measured, P, N.
        reference: that (27) goes by, P_ref, N.
    """

    def __init__(
        self, sensors: tuple[WrenchSensor, WrenchSensor], gains: AdmittanceGains | None = None
    ) -> None:
        self.sensors = sensors
        self.gains = gains or AdmittanceGains()
        self.target: float | None = None
        self.start()

    def start(self) -> None:
        """Forget the past and the target."""
        self.target = None
        self.force = self._force_rate = self._goal = self._goal_rate = 0.0
        self._counted = self._missing = 0.0
        for sensor in self.sensors:
            sensor.start()

    @property
    def reference(self) -> float:
        """See the class."""
        return self._goal - self._missing

    def presses(self, goals: Goals) -> bool:
        """Return whether the hands press: both have goals, and both sensors are heard."""
        silent = any(sensor.silent for sensor in self.sensors)
        unset = goals.pose_des is None or None in goals.others
        return not (self.target is None or silent or unset)

    def observe(self, robot: RobotModel, goals: Goals, elapsed: float) -> None:
        """Go by what is measured; take the poses where the hands are for goals when it ends.

        Args:
            robot: updated to the current state.
            goals: of the arm.
            elapsed: time since the last step, s.
        """
        was_active = self.presses(goals)
        for sensor, hand in zip(self.sensors, (robot, *robot.others), strict=True):
            sensor.update(hand.pose.rotation, elapsed)
        if not self.presses(goals):
            self._missing = self._counted = 0.0
            if was_active:
                goals.hold(robot.pose)
                goals.hold_others([hand.pose for hand in robot.others])
            return
        d = closing_direction(robot)
        wrenches = [np.concatenate(parts) for parts in zip(*self._measured(), strict=True)]
        self.force, self._force_rate = (-0.5 * float(d @ each) for each in wrenches)
        if not was_active:
            self._goal = self.force
        before = self._goal
        assert self.target is not None
        if elapsed > 0.0:
            self._goal += -math.expm1(-elapsed / WRENCH_TIME) * (self.target - before)
            self._goal_rate = (self._goal - before) / elapsed
        # As of a hand alone: hardly more than is felt, or they would rush at the object.
        self._counted = min(max(self._goal, 0.0), max(self.force, 0.0) + FORCE_STEP)

    def _measured(self) -> list[tuple[Array, Array]]:
        return [(sensor.wrench, sensor.rate) for sensor in self.sensors]

    def tasks(self, goals: Goals, gains: Gains) -> list[Task]:
        """Return the tasks of a step in which the hands press, and have goals for their poses.

        Args:
            goals: of the arm.
            gains: of the tasks.
        """
        if gains.pose_weight == 0.0:  # no pose task to stand in for
            return goals.tasks(gains)
        plain = replace(gains, pose_speed_max=np.array([]))
        tasks = goals.tasks(plain)
        first, second = tasks[0], tasks[1]
        error, rate = self.reference - self.force, self._goal_rate - self._force_rate
        kp, kd = self.gains.kp[0], self.gains.kd[0]
        most = gains.pose_kd * self.gains.speed_max[0]
        closing = min(max(kp * error + kd * rate, -most), most)
        assert isinstance(first, PoseTask)
        assert isinstance(second, OtherHandTask)
        return [SqueezeTask(first, second.task, closing), *tasks[2:]]

    def forces(self, robot: RobotModel) -> ContactForces:
        """Return the squeeze as a force of the environment, rho = P, with its task, III-E (a).

        Args:
            robot: updated to the current state.
        """
        J = np.vstack([robot.J, robot.others[0].J])
        B = -(J.T @ closing_direction(robot))[:, None]
        wanted = WrenchTerm(np.ones((1, 1)), np.array([self._counted]), WRENCH_WEIGHT, 0)
        return ContactForces(B, np.array([np.inf]), [wanted])

    def note_forces(self, rho: Array) -> None:
        """Take note of the force that the QP counts on, shape (1,), N."""
        self._missing = self._counted - float(rho[0])
