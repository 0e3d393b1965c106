# SPDX-License-Identifier: Apache-2.0
"""Bumpless handover between the robot's position control and torque control.

[Benallegue2021], IV-A: the position reference is captured and held while the QP computes its
first torque for the present configuration; from the next step on torque is commanded. The
integral action starts with the difference between the measured and the computed torque, so that
the commanded torque is continuous (`Controller.bumpless_transfer`). The measured torque is an
average: positions are held until it is known well enough.

Position-controlled drives stop a moving arm as hard as they can. On the way back the arm is
therefore first brought to rest under torque control.
"""

from __future__ import annotations

from enum import Enum

import numpy as np
from numpy.typing import ArrayLike, NDArray

from torque_safety_controller.safety.torque_average import TorqueAverage
from viability_bounds_pkg.exceptions import ArmSafetyError

Array = NDArray[np.float64]

TORQUE_TOLERANCE = 0.01
"""Share of its limit by which a measured torque may exceed it; the torque step is no larger."""

REST_SPEED = 0.02
"""Speed below which a joint counts as at rest, rad/s."""

TORQUE_ERROR = 0.005
"""Share of its limit by which the averaged torque of a motor may be off at the handover."""

AVERAGING_TIME = 1.0
"""Longest time that the torque of the motors is averaged over, s."""

PATIENCE = 2.0
"""Longest time to wait for the torque of the motors to be known, s."""

REST_PATIENCE = 2.0
"""Longest time to wait for the arm to come to rest, s; under external forces it may not."""


class Control(Enum):
    """Which control commands the joints."""

    TORQUE = "torque"
    POSITION = "position"
    """The drives hold the positions that they are sent."""
    TAKING_OVER = "taking over"
    """Still position control, while the QP computes its first torque."""
    GIVING_BACK = "giving back"
    """Still torque control, which brings the arm to rest."""


class HandoverRefused(ArmSafetyError, ValueError):
    """A change of control that is not possible now; the text says why."""


class Handover:
    """State machine of the change between position and torque control.

    Args:
        control: ``torque`` or ``position``.
        joints: names of the n joints.
        q_min: lower position limits, shape (n,), rad.
        q_max: upper position limits, shape (n,), rad.
        tau_max: torque limits, shape (n,), N m.
        dt: control period, s.

    Attributes:
        control: present control.
        reason: of the last change.
        torque: of the motors, averaged for the handover, as far as it is known.
    """

    def __init__(
        self,
        control: str,
        joints: tuple[str, ...],
        q_min: ArrayLike,
        q_max: ArrayLike,
        tau_max: ArrayLike,
        dt: float,
    ) -> None:
        self.control = self._start = Control(control)
        self.reason = "as at start"
        self._q_hold: Array | None = None
        self._waited = 0.0
        self._joints = joints
        self._q_min, self._q_max = np.asarray(q_min), np.asarray(q_max)
        self._tau_max = np.asarray(tau_max)
        self._dt = dt
        self._average = TorqueAverage(self._tau_max, round(AVERAGING_TIME / dt))
        self.torque = self._average.best()

    @property
    def by_drives(self) -> bool:
        """Whether positions are sent."""
        return self.control in (Control.POSITION, Control.TAKING_OVER)

    def hold(self, q: Array) -> Array:
        """Return the position to hold, captured at the first call.

        Args:
            q: position now, shape (n,), rad.
        """
        if self._q_hold is None:
            self._q_hold = q.copy()
        return self._q_hold

    def robot_was_away(self) -> None:
        """Reset after the robot was silent or restarted; never starts torque control by itself."""
        between = (Control.TAKING_OVER, Control.GIVING_BACK)
        back = self._start is Control.POSITION or self.control in between
        if back and self.control is not Control.POSITION:
            self._set(Control.POSITION, "the robot was silent or started over")
        self._q_hold = None

    def to_torque(self, q: Array, tau: Array | None, fresh: bool, bounds_fresh: bool) -> None:
        """Begin the handover to torque control; `average` completes it.

        Cancels a handover to position control.

        Args:
            q: position, shape (n,), rad.
            tau: torque of the motors, shape (n,), N m; None if it is not measured.
            fresh: whether joint states arrive.
            bounds_fresh: whether acceleration limits arrive.

        Raises:
            HandoverRefused: it would not be safe, or not smooth.
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
        tau = self._within_limits(self._measured(q, tau))
        self._average.clear()
        self._average.add(tau)
        self._waited = 0.0
        self._set(Control.TAKING_OVER, "enable_torque")

    def average(self, q: Array, tau: Array | None) -> Array | None:
        """Return the torque that torque control can begin with, or None if it is to wait.

        To be called with each state while it is being taken over.

        Args:
            q: position, shape (n,), rad.
            tau: torque of the motors, shape (n,), N m; None if it is not measured.

        Raises:
            HandoverRefused: it cannot begin.
        """
        self._average.add(self._measured(q, tau))
        self._waited += self._dt
        self.torque = self._average.best()
        worst = int(np.argmax(self.torque.error))
        if (error := self.torque.error[worst]) <= TORQUE_ERROR:
            return self._within_limits(self.torque.mean)
        if self._waited > PATIENCE:
            raise HandoverRefused(
                f"after {PATIENCE:g} s the torque of {self._joints[worst]} is known to "
                f"{error:.2%} of torque_max only, by noise or motion; allowed: {TORQUE_ERROR:.2%}"
            )
        return None

    def _measured(self, q: Array, tau: Array | None) -> Array:
        outside = (q < self._q_min) | (q > self._q_max)
        if outside.any():
            raise HandoverRefused(f"outside the position limits: {self._names(outside)}")
        if tau is None:
            raise HandoverRefused("joint_states carry no motor torque (effort)")
        return tau

    def _within_limits(self, tau: Array) -> Array:
        beyond = np.abs(tau) > (1.0 + TORQUE_TOLERANCE) * self._tau_max
        if beyond.any():
            raise HandoverRefused(f"motor torque beyond torque_max: {self._names(beyond)}")
        return tau

    def taken_over(self) -> None:
        """Enter torque control; the next step commands torque."""
        self._set(Control.TORQUE, "enable_torque")
        self._q_hold = None

    def failed(self, reason: str) -> None:
        """Return to position control because the handover failed."""
        self._set(Control.POSITION, f"handover failed: {reason}")

    def to_position(self, q: Array, v: Array, fresh: bool) -> None:
        """Begin the handover to position control, which waits until the arm is at rest.

        Args:
            q: position, shape (n,), rad.
            v: velocity, shape (n,), rad/s.
            fresh: whether joint states arrive.

        Raises:
            HandoverRefused: position control is on, or the position is not known.
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

    def slow_down(self, q: Array, v: Array, elapsed: float) -> None:
        """Enter position control if the arm is at rest, or after `REST_PATIENCE`.

        Args:
            q: position, shape (n,), rad.
            v: velocity, shape (n,), rad/s.
            elapsed: time since the last call, s.
        """
        self._waited += elapsed
        if np.abs(v).max() <= REST_SPEED or self._waited > REST_PATIENCE:
            self._q_hold = q.copy()
            self._set(Control.POSITION, "enable_torque")

    def _set(self, control: Control, reason: str) -> None:
        self.control, self.reason = control, reason

    def _names(self, flags: NDArray[np.bool_]) -> str:
        return ", ".join(name for name, flag in zip(self._joints, flags, strict=True) if flag)
