# SPDX-License-Identifier: Apache-2.0
"""Forces at the hand: exerting a target wrench, and yielding to external ones.

[Benallegue2021], III-E and IV-C. Wrenches are those of the environment on the arm, about the end
effector's origin and in its axes; what the arm is to exert is the negative. Dual compliance holds
the pose while the wrench is below a threshold; above it the hand yields, and where the wrench ends
is the new goal.
"""

from __future__ import annotations

import math
from enum import Enum
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from torque_safety_controller.parts.contact.contacts import FrictionContact
from torque_safety_controller.parts.contact.wrench_sensor import WrenchSensor
from torque_safety_controller.parts.goals import Goals
from torque_safety_controller.robot_model import RobotModel
from torque_safety_controller.step import Part, Settings, Step
from torque_safety_controller.tasks.admittance import (
    AdmittanceTask,
    InteractionSettings,
    admittance,
)
from torque_safety_controller.tasks.pose_task import shorten
from torque_safety_controller.tasks.task import Task

Array = NDArray[np.float64]

WRENCH_WEIGHT = 10.0
"""Of the wrench tasks: of squared errors of forces and moments in the QP."""

WRENCH_TIME = 0.1
"""Time constant with which a new target wrench is gone over to, s."""

FORCE_STEP = 0.5
"""By how much the force that the QP counts on at the hand may exceed the measured one along the
contact's normal, N: the hand neither rushes at what it is to touch, nor presses on nothing."""

PRESS_SPEED_MAX = (0.005, 0.05)
"""Speeds at which the hand approaches what it is to press on at most, m/s and rad/s."""

YIELD_RELEASE = 0.5
"""Share of the thresholds of dual compliance below which the hand stops to yield."""

YIELD_KP = (0.1, 1.0)
"""Kp of (27) for a hand that yields, m/s^2 per N and rad/s^2 per N m."""

YIELD_SPEED_MAX = (0.25, 1.0)
"""Speeds at which it yields at most, m/s and rad/s."""


class Compliance(Enum):
    """What is done about the wrench at the hand."""

    OFF = "off"
    """Nothing: there is no sensor, or nothing was asked for."""
    HOLDING = "holding"
    """The pose is held; the hand yields to wrenches above the threshold."""
    YIELDING = "yielding"
    """The hand yields to the measured wrench."""
    FORCE = "force"
    """A wrench is exerted in the directions set for it."""
    SILENT = "sensor silent"
    """As OFF, for want of measurements."""


class Interaction(Part):
    """Exerts wrenches at the hand, and yields to them: there its pose becomes the goal.

    Args:
        goals: of the arm.
        sensor: at the hand.
        contact: the hand's, with which a wrench is exerted; None for none.
        placement: of the contact's frame in the end effector's.
        settings: may be replaced between steps.

    Attributes:
        sensor, contact, settings: as given.
        state: what is done at present.
        reason: why.
        changes: how often the state has changed.
        yield_kp: Kp of (27) for a hand that yields, for forces and moments.
        reference: wrench that (27) goes by, F_ref, shape (6,).
    """

    def __init__(
        self,
        goals: Goals,
        sensor: WrenchSensor,
        contact: FrictionContact | None = None,
        placement: pin.SE3 | None = None,
        settings: InteractionSettings | None = None,
    ) -> None:
        self._goals, self.sensor, self.contact = goals, sensor, contact
        self.yield_kp = YIELD_KP
        placement = placement or pin.SE3.Identity()
        self._to_hand = placement.toDualActionMatrix()  # from the contact's frame
        self._to_contact = np.ascontiguousarray(placement.inverse().toDualActionMatrix())
        self._target: tuple[Array, Array | None] | None = None
        self._turned = False
        self._settings = self.settings = settings or InteractionSettings()
        self.state, self.reason, self.changes = Compliance.OFF, "at start", 0
        self._clear()

    @property
    def settings(self) -> InteractionSettings:
        """Settings; the next step goes by them."""
        return self._settings

    @settings.setter
    def settings(self, settings: InteractionSettings) -> None:
        # What was pressed along is to be held where it is, not where a goal was meanwhile.
        directions = settings.force_directions
        self._turned |= not np.array_equal(directions, self._settings.force_directions)
        self._settings = settings
        self._rows = np.flatnonzero(directions)
        self._shares: Array = 1.0 - directions

    def _clear(self) -> None:
        self._target = None
        self._goal = self._goal_rate = self.reference = np.zeros(6)
        self._counted = np.zeros(6)  # on in the QP, at the contact, in its axes
        self._missing = np.zeros(6)  # of that, in the end effector's axes
        self._enter(Compliance.OFF, "at start")
        self.sensor.start()

    def set_target(self, wrench: Array, rotation: Array | None = None) -> None:
        """Exert a wrench in the directions set for it.

        Args:
            wrench: what the arm is to exert about the end effector's origin, shape (6,), N and
                N m.
            rotation: of the frame that its axes are those of, in the root frame; None for the
                end effector's axes.
        """
        self._target = (-np.asarray(wrench, dtype=float), rotation)

    @property
    def has_target(self) -> bool:
        """Whether a wrench is to be exerted."""
        return self._target is not None

    def end_target(self) -> None:
        """Exert no wrench any more; the hand stays where it is."""
        self._target = None

    def configure(self, settings: Settings) -> None:
        """See `Part.configure`."""
        self.settings = settings.interaction

    def reset(self, robot: RobotModel) -> None:
        """Forget the past and the target."""
        self._clear()

    def remodel(self, robot: RobotModel) -> None:
        """Have the sensor feel what the hand carries."""
        if self.sensor.frame:
            self.sensor.carry(robot.payload.beyond(self.sensor.frame))

    def prepare(self, step: Step) -> None:
        """Add the admittance task, (27), and what the contact may exert."""
        self._change_state(step.robot, step.elapsed)
        if not (step.order.track and self._goals.any):
            return
        step.tasks += self._tasks()
        if self.state is Compliance.FORCE:
            step.stiffness = self._shares
            if self.contact is not None:
                model, data = step.robot.model, step.robot.data
                step.forces = self.contact.forces(model, data, self._counted, WRENCH_WEIGHT)

    def learn(self, step: Step) -> None:
        """Remember what the QP counts on at the contact less than is wanted."""
        if step.forces is None or step.solution is None or self.contact is None:
            return
        missing = self._counted - self.contact.wrench(step.solution.rho)
        if not self.contact.exerts_moments:
            missing[3:] = 0.0  # a point exerts no moment; none was asked of it
        self._missing = self._to_hand @ missing

    def report(self) -> dict[str, Any]:
        """See `Part.report`."""
        return {
            "compliance": self.state.value,
            "compliance_reason": self.reason,
            "compliance_changes": self.changes,
            "hand_wrench": self.sensor.wrench,
            "target_wrench": np.zeros(6) if self._target is None else -self._target[0],
            "ft_bias": self.sensor.bias,
        }

    @property
    def trouble(self) -> str:
        """See `Part.trouble`."""
        return "the force/torque sensor is silent" if self.state is Compliance.SILENT else ""

    def _change_state(self, robot: RobotModel, elapsed: float) -> None:
        """Choose what is done, and make the pose of a hand that yields its goal."""
        sensor, goals, threshold = self.sensor, self._goals, self._settings.yield_threshold
        sensor.update(robot.pose.rotation, elapsed)
        wrench = sensor.wrench
        if sensor.silent:
            wanted = self._target is not None or len(threshold) > 0
            if self.state in (Compliance.FORCE, Compliance.YIELDING):
                # Nothing is known of what touches the hand: stop, and stay.
                goals.hold(robot.pose)
                self._target, wanted = None, True
            if self.state is not Compliance.SILENT:
                self._enter(Compliance.SILENT if wanted else Compliance.OFF, "no measurement")
            return
        if self._target is not None and self._rows.size:
            self._exert(*self._target, robot, elapsed)
            return
        if self.state is Compliance.FORCE:
            goals.hold(robot.pose)
            self._target = None
        if not len(threshold) or goals.pose_des is None:
            self._enter(Compliance.OFF, "no target wrench")
            return
        share = YIELD_RELEASE if self.state is Compliance.YIELDING else 1.0
        force, moment = (share * threshold).tolist()
        if math.hypot(*wrench[:3]) > force or math.hypot(*wrench[3:]) > moment:
            # The goal follows the hand, so that no stiffness acts against the motion.
            goals.hold(robot.pose)
            self._enter(Compliance.YIELDING, "wrench above the threshold")
        else:
            self._enter(Compliance.HOLDING, "wrench below the threshold")

    def _exert(
        self, wrench: Array, rotation: Array | None, robot: RobotModel, elapsed: float
    ) -> None:
        """Bring what is to be felt nearer to a wrench, see `set_target`."""
        goals, measured = self._goals, self.sensor.wrench
        if rotation is not None:
            wrench = (wrench.reshape(2, 3) @ rotation.T @ robot.pose.rotation).ravel()
        if self.state is not Compliance.FORCE:
            self._enter(Compliance.FORCE, "target wrench")
            if goals.pose_des is None:
                goals.hold(robot.pose)  # its damping is needed
            self._goal, self._missing = measured, np.zeros(6)
        elif self._turned:
            goals.hold(robot.pose)
        self._turned = False
        before, self._goal_rate = self._goal, np.zeros(6)
        if elapsed > 0.0:
            self._goal = before - math.expm1(-elapsed / WRENCH_TIME) * (wrench - before)
            self._goal_rate = (self._goal - before) / elapsed
        # What the QP says that limits allow is what is to be felt: III-E (b), one step late.
        self.reference = self._goal - self._missing
        if self.contact is not None:
            self._counted = _counted(self._goal, measured, self._to_contact, self.contact)

    def _tasks(self) -> list[Task]:
        """Return the admittance task, (27), if there is one in this state."""
        settings, sensor, gains = self._settings, self.sensor, self._goals.gains
        if gains.pose_weight == 0.0:
            return []
        F, rate = sensor.wrench, sensor.rate
        if self.state is Compliance.YIELDING:
            g = admittance(-F, -rate, self.yield_kp, YIELD_SPEED_MAX, gains.pose_kd)
            return [AdmittanceTask(g, gains.pose_weight, np.arange(6))]
        if self.state is not Compliance.FORCE:
            return []
        mask = settings.force_directions
        g = admittance(
            mask * (self.reference - F),
            mask * (self._goal_rate - rate),
            settings.admittance_kp.tolist(),
            PRESS_SPEED_MAX,
            gains.pose_kd,
        )
        return [AdmittanceTask(g, gains.pose_weight, self._rows)]

    def _enter(self, state: Compliance, reason: str) -> None:
        if state is not self.state:
            self.state, self.reason = state, reason
            self.changes += 1


def _counted(goal: Array, measured: Array, to_contact: Array, contact: FrictionContact) -> Array:
    """Return the wrench that the QP may count on at a contact, in its axes, shape (6,).

    Along the normal it exceeds what is felt by `FORCE_STEP` at most; across it, and as a moment,
    it is what a contact that presses so can give: the QP would press harder for the sake of it, on
    nothing perhaps.

    Args:
        goal: wrench on the arm that is wanted, in the end effector's axes, shape (6,).
        measured: wrench on the arm, likewise.
        to_contact: takes wrenches to the contact's axes and origin, shape (6, 6).
        contact: has normal, friction and lever.
    """
    normal = contact.normal
    counted = to_contact @ goal
    wanted = float(normal @ counted[:3])
    felt = float(normal @ (to_contact[:3] @ measured))
    share = min(1.0, (max(felt, 0.0) + FORCE_STEP) / wanted) if wanted > 0.0 else 0.0
    pressing = share * wanted
    counted *= share
    counted[:3] -= pressing * normal
    shorten(counted[:3], contact.friction * pressing)
    counted[:3] += pressing * normal
    shorten(counted[3:], contact.lever * math.hypot(*counted[:3].tolist()))
    return counted
