# SPDX-License-Identifier: Apache-2.0
"""From position control by the robot's own drives to torque control and back, without a jolt.

[Benallegue2021], IV-A: the position reference is captured and held while the QP, at the arm's own
configuration, makes its first torque; in the next step torque is what the robot is given. The
integral action begins with the difference between the torque measured and the one computed, so
that the torque goes on from what the drives applied (`Controller.bumpless_transfer`).

Drives brake an arm in motion as hard as they can. So on the way back it is brought to rest under
torque control first.
"""

from __future__ import annotations

from enum import Enum

import numpy as np
from numpy.typing import ArrayLike

from viability_bounds_pkg.exceptions import ArmSafetyError

TORQUE_TOLERANCE = 0.01
"""By how much of its limit a measured torque may exceed it: the step that is left is no larger."""


REST_SPEED = 0.02
"""Joints slower than this, rad/s, are at rest enough for drives to take them."""

PATIENCE = 2.0
"""How long an arm is waited for to come to rest, s; one that somebody pushes may not."""


class Control(Enum):
    """Who is in command of the joints."""

    TORQUE = "torque"
    POSITION = "position"
    """The drives, at positions that they are sent."""
    TAKING_OVER = "taking over"
    """Still the drives, while the QP makes its first torque."""
    GIVING_BACK = "giving back"
    """Torque still, which brings the arm to rest before the drives take it."""


class HandoverRefused(ArmSafetyError, ValueError):
    """The control of the arm stays what it is; the text says why."""


class Handover:
    """Keeps track of what controls the arm: its drives, or torque.

    Args:
        control: ``torque`` or ``position``.
        joints: names of the n joints.
        q_min: lower position limits, shape (n,), rad.
        q_max: upper position limits, shape (n,), rad.
        tau_max: torque limits, shape (n,), N m.

    Attributes:
        control: what controls the arm at present.
        reason: why.
    """

    def __init__(
        self,
        control: str,
        joints: tuple[str, ...],
        q_min: ArrayLike,
        q_max: ArrayLike,
        tau_max: ArrayLike,
    ) -> None:
        self.control = self._start = Control(control)
        self.reason = "as at start"
        self._q_hold: np.ndarray | None = None
        self._waited = 0.0
        self._joints = joints
        self._q_min, self._q_max = np.asarray(q_min), np.asarray(q_max)
        self._tau_max = np.asarray(tau_max)

    @property
    def by_drives(self) -> bool:
        """Whether positions are to be sent."""
        return self.control in (Control.POSITION, Control.TAKING_OVER)

    def hold(self, q: np.ndarray) -> np.ndarray:
        """Return where the drives are to hold the joints, captured at the first call.

        Args:
            q: position now, shape (n,), rad.
        """
        if self._q_hold is None:
            self._q_hold = q.copy()
        return self._q_hold

    def robot_was_away(self) -> None:
        """Begin anew, the robot having been silent or started over: never with torque unasked."""
        between = (Control.TAKING_OVER, Control.GIVING_BACK)
        back = self._start is Control.POSITION or self.control in between
        if back and self.control is not Control.POSITION:
            self._set(Control.POSITION, "the robot was silent or started over")
        self._q_hold = None

    def to_torque(
        self, q: np.ndarray, tau: np.ndarray | None, fresh: bool, bounds_fresh: bool
    ) -> None:
        """Begin the handover to torque control; the next state with limits completes it.

        One from torque that is under way is called off.

        Args:
            q: position, shape (n,), rad.
            tau: torque of the motors, shape (n,), N m, or None if the robot does not tell.
            fresh: whether joint states come.
            bounds_fresh: whether acceleration limits come.

        Raises:
            HandoverRefused: it would not be safe, or smooth.
        """
        if self.control is Control.TORQUE:
            raise HandoverRefused("torque control is on already")
        if not fresh:
            raise HandoverRefused("no joint state, or only old ones")
        if not bounds_fresh:
            raise HandoverRefused("no acceleration limits, or only old ones")
        if self.control is Control.GIVING_BACK:
            self._set(Control.TORQUE, "enable_torque")
            return
        self.check(q, tau)
        self._set(Control.TAKING_OVER, "enable_torque")

    def check(self, q: np.ndarray, tau: np.ndarray | None) -> np.ndarray:
        """Return `tau`, if torque control can begin in this state; see `to_torque`.

        Raises:
            HandoverRefused: it cannot.
        """
        outside = (q < self._q_min) | (q > self._q_max)
        if outside.any():
            raise HandoverRefused(f"outside the position limits: {self._names(outside)}")
        if tau is None:
            raise HandoverRefused("joint_states carry no motor torque (effort)")
        beyond = np.abs(tau) > (1.0 + TORQUE_TOLERANCE) * self._tau_max
        if beyond.any():
            raise HandoverRefused(f"motor torque beyond torque_max: {self._names(beyond)}")
        return tau

    def taken_over(self) -> None:
        """Note that torque is commanded from the next step on."""
        self._set(Control.TORQUE, "enable_torque")
        self._q_hold = None

    def failed(self, reason: str) -> None:
        """Leave the arm to the drives, where they hold it."""
        self._set(Control.POSITION, f"handover failed: {reason}")

    def to_position(self, q: np.ndarray, v: np.ndarray, fresh: bool) -> None:
        """Let the drives hold the arm where it is, or where it comes to rest.

        Args:
            q: position, shape (n,), rad.
            v: velocity, shape (n,), rad/s.
            fresh: whether joint states come.

        Raises:
            HandoverRefused: they do so already, or nobody knows where it is.
        """
        if self.control in (Control.POSITION, Control.GIVING_BACK):
            raise HandoverRefused("position control is on already")
        if not fresh:
            raise HandoverRefused("no joint state, or only old ones")
        if self.control is Control.TAKING_OVER:
            self._set(Control.POSITION, "enable_torque")
            return
        self._waited = 0.0
        self._set(Control.GIVING_BACK, "enable_torque")
        self.slow_down(q, v, 0.0)

    def slow_down(self, q: np.ndarray, v: np.ndarray, elapsed: float) -> None:
        """Let the drives take the arm from the next state on if it is at rest, or was waited for.

        Args:
            q: position, shape (n,), rad.
            v: velocity, shape (n,), rad/s.
            elapsed: time since it was asked for last, s.
        """
        self._waited += elapsed
        if np.abs(v).max() <= REST_SPEED or self._waited > PATIENCE:
            self._q_hold = q.copy()
            self._set(Control.POSITION, "enable_torque")

    def _set(self, control: Control, reason: str) -> None:
        self.control, self.reason = control, reason

    def _names(self, flags: np.ndarray) -> str:
        return ", ".join(name for name, flag in zip(self._joints, flags, strict=True) if flag)
