"""The torque that is added to the model's: integral action in one of its modes, without jumps.

Modes are ``none``; ``joints``, every joint stiff, (3)-(14) of [Benallegue2021]; and ``task``, stiff
in the task and free in its null space, (15)-(26). Whatever is changed while the arm moves, the
torque goes on from where it was.
"""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from torque_safety_controller.integral_feedback import IntegralFeedback, SeedingError
from torque_safety_controller.integral_settings import IntegralSettings
from torque_safety_controller.nullspace_compliance import NullspaceCompliance
from torque_safety_controller.nullspace_settings import NullspaceSettings
from torque_safety_controller.robot_model import RobotModel

Array = NDArray[np.float64]

MODES = ("none", "joints", "task")

LONGEST_GAP = 2.5
"""Steps that a missed deadline or two may take; after a longer gap nothing is integrated."""

_FADING_TIME = 0.2  # s; of what a mode cannot take over
_NEGLIGIBLE = 1e-9  # N m


@dataclass(frozen=True, eq=False)
class AdditionalSettings:
    """What may change while the controller runs.

    Attributes:
        mode: one of `MODES`.
        joints: of mode ``joints``.
        task: of mode ``task``; None where the task leaves no null space.
    """

    mode: str
    joints: IntegralSettings
    task: NullspaceSettings | None


class AdditionalTorque:
    """Additional torque of one arm.

    Args:
        settings: may be replaced between steps: the torque does not jump.
        rows: which rows of the pose's Jacobian are the task of mode ``task``.

    Attributes:
        last: what the last step added, shape (n,), N m.
        joints: the integral action of mode ``joints``.
        task: that of mode ``task``, or None.
    """

    def __init__(self, settings: AdditionalSettings, rows: slice = slice(0, 6)) -> None:
        n = len(settings.joints.budget)
        self.joints = IntegralFeedback(settings.joints)
        self.task: NullspaceCompliance | None = None
        if settings.task is not None:
            self.task = NullspaceCompliance(settings.task, rows.stop - rows.start)
        self._rows = rows
        self._settings = settings
        self._mode = settings.mode
        self.last = np.zeros(n)
        self._fading = np.zeros(n)
        self._faded = True

    @property
    def settings(self) -> AdditionalSettings:
        """Settings; the next step goes over to them."""
        return self._settings

    @settings.setter
    def settings(self, settings: AdditionalSettings) -> None:
        self._settings = settings
        self.joints.settings = settings.joints
        if self.task is not None and settings.task is not None:
            self.task.settings = settings.task

    @property
    def idle(self) -> bool:
        """Whether nothing is added, so that the model needs no rates of its matrices."""
        return self._mode == self._settings.mode == "none" and self._faded

    @property
    def saturated(self) -> NDArray[np.bool_]:
        """Which joints are at their budget, shape (n,)."""
        if self._mode == "joints":
            return self.joints.saturated
        return np.full(self.last.size, self._mode == "task" and self.task.limited)

    def start(self, robot: RobotModel, v: Array) -> None:
        """Forget the past.

        Args:
            robot: of the arm, updated.
            v: velocity now, shape (n,), rad/s.
        """
        self._mode = self._settings.mode
        self.last = np.zeros(v.size)
        self._fading.fill(0.0)
        self._faded = True
        if self._mode == "joints":
            self.joints.start(v)
        elif self._mode == "task":
            self.task.start(v, robot.J[self._rows])

    def torque(self, robot: RobotModel, v: Array, a_last: Array, elapsed: float) -> Array:
        """Return what to add in this step, shape (n,), N m.

        Args:
            robot: of the arm, updated with rates.
            v: velocity, shape (n,), rad/s.
            a_last: acceleration commanded in the last step, shape (n,), rad/s^2.
            elapsed: time since the last step, s; a jump in time is not integrated over.
        """
        try:
            torque = self._integrated(robot, v, a_last, elapsed)
        except ValueError:
            return self.last  # absurd numbers, over which nothing is integrated
        if not self._faded:
            gap = elapsed if 0.0 < elapsed < math.inf else 0.0
            self._fading *= math.exp(-gap / _FADING_TIME)
            self._faded = bool(np.abs(self._fading).max() < _NEGLIGIBLE)
            torque = torque + self._fading
        if self._mode != self._settings.mode:
            torque = self.seed(robot, v, torque)
        self.last = torque
        return torque

    def _integrated(self, robot: RobotModel, v: Array, a_last: Array, elapsed: float) -> Array:
        """Return the torque of the present mode."""
        if not 0.0 < elapsed <= LONGEST_GAP * robot.dt:
            self._skip(robot, v, elapsed)
            a_last, elapsed = np.zeros(v.size), 0.0
        if self._mode == "joints":
            return self.joints.torque(robot.M, robot.C, v, a_last, elapsed)
        if self._mode == "task":
            rows = self._rows
            return self.task.torque(
                robot.M, robot.C, robot.J[rows], robot.J_dot[rows], v, a_last, elapsed
            )
        return np.zeros(v.size)

    def seed(self, robot: RobotModel, v: Array, torque: Array) -> Array:
        """Enter the mode that is set so that it gives `torque` now; return that.

        The mode takes over what it can, within budgets that are widened as far as they must be
        and for some time; the rest fades.

        Args:
            robot: of the arm, updated with rates.
            v: velocity, shape (n,), rad/s.
            torque: shape (n,), N m.
        """
        self._mode = self._settings.mode
        taken = np.zeros(torque.size)
        if self._mode == "joints":
            self.joints.start(v)
            with suppress(SeedingError):  # too fast: all of it fades
                taken = self.joints.seed(torque, robot.M, robot.C)
        elif self._mode == "task":
            rows = self._rows
            taken = self.task.seed(torque, robot.M, robot.C, robot.J[rows], robot.J_dot[rows], v)
        self._fading = torque - taken
        self._faded = bool(np.abs(self._fading).max() < _NEGLIGIBLE)
        self.last = torque
        return torque

    def _skip(self, robot: RobotModel, v: Array, elapsed: float) -> None:
        gap = elapsed if 0.0 <= elapsed < math.inf else 0.0
        if self._mode == "joints":
            self.joints.skip(v, gap)
        elif self._mode == "task":
            self.task.skip(v, robot.J[self._rows], gap)
