"""From position control by the robot's own drives to torque control and back, without a jolt.

[Benallegue2021], IV-A: the position reference is captured and held while the QP, at the arm's own
configuration, makes its first torque; in the next step torque is what the robot is given. The
integral action begins with the difference between the torque measured and the one computed, so
that the torque goes on from what the drives applied (`Controller.take_over`).
"""

from __future__ import annotations

from enum import Enum

import numpy as np


class Control(Enum):
    """Who is in command of the joints."""

    TORQUE = "torque"
    POSITION = "position"
    """The drives, at positions that they are sent."""
    TAKING_OVER = "taking over"
    """Still the drives, while the QP makes its first torque."""


class HandoverRefused(ValueError):
    """The control of the arm stays what it is; the text says why."""


class Handover:
    """Keeps who is in command.

    Args:
        control: ``torque`` or ``position``.
        joints: names of the n joints.
        q_min: lower position limits, shape (n,), rad.
        q_max: upper position limits, shape (n,), rad.

    Attributes:
        control: who is in command.
        q_hold: where the drives are to hold the joints, shape (n,), rad.
    """

    def __init__(self, control: str, joints: tuple[str, ...], q_min, q_max) -> None:
        self.control = Control(control)
        self.q_hold: np.ndarray | None = None
        self._joints, self._q_min, self._q_max = joints, q_min, q_max

    @property
    def by_drives(self) -> bool:
        """Whether positions are to be sent."""
        return self.control is not Control.TORQUE

    def hold(self, q: np.ndarray) -> np.ndarray:
        """Return where the drives are to hold the joints, captured at the first call."""
        if self.q_hold is None:
            self.q_hold = q.copy()
        return self.q_hold

    def forget(self) -> None:
        """Capture the position anew: the robot started over."""
        self.q_hold = None
        if self.control is Control.TAKING_OVER:
            self.control = Control.POSITION

    def to_torque(
        self, q: np.ndarray, tau: np.ndarray | None, fresh: bool, bounds_fresh: bool
    ) -> None:
        """Begin the handover to torque control; the next state with limits completes it.

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
        outside = np.flatnonzero((q < self._q_min) | (q > self._q_max))
        if outside.size:
            names = ", ".join(self._joints[j] for j in outside)
            raise HandoverRefused(f"outside the position limits: {names}")
        if tau is None:
            raise HandoverRefused("joint_states carry no motor torque (effort)")
        self.control = Control.TAKING_OVER

    def taken_over(self) -> None:
        """Note that torque is commanded from the next step on."""
        self.control = Control.TORQUE

    def to_position(self, q: np.ndarray, fresh: bool) -> None:
        """Let the drives hold the arm where it is.

        Raises:
            HandoverRefused: they do so already, or nobody knows where it is.
        """
        if self.control is Control.POSITION:
            raise HandoverRefused("position control is on already")
        if not fresh:
            raise HandoverRefused("no joint state, or only old ones")
        self.control = Control.POSITION
        self.q_hold = q.copy()
