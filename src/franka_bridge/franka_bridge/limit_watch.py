# SPDX-License-Identifier: Apache-2.0
"""Judges a Franka arm's own states and torques by its limits, as the robot would."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


class LimitWatch:
    """Largest excess over each limit of n joints; what is not a number counts as a violation.

    Nothing here is shared with the control: the robot's speed limit at distances l, u to the
    position limits is written out,

        min(v_max, max(0, sqrt(2 d l) - c)) downwards, with u upwards,

    with d the deceleration limit and c the velocity offset of the robot's URDF.

    Args:
        q_min: lower position limits, shape (n,), rad.
        q_max: upper position limits, shape (n,), rad.
        v_max: speed limits, shape (n,), rad/s.
        velocity_offset: c, shape (n,), rad/s.
        deceleration_limit: d, shape (n,), rad/s^2.
        tau_max: torque limits, shape (n,), N m.
        rate_max: limits of torque rates, shape (n,), N m/s.
        dt: period of the updates, s.

    Attributes:
        position: farthest beyond a position limit, shape (n,), rad; 0 where never beyond.
        speed: largest excess over the speed limit at the position, shape (n,), rad/s.
        torque: largest torque that the motors were asked for, share of its limit, shape (n,).
        rate: largest rate of torques sent, share of its limit, shape (n,).
        lower, upper: least distance to the position limits, shape (n,), rad.
    """

    def __init__(
        self,
        q_min: ArrayLike,
        q_max: ArrayLike,
        v_max: ArrayLike,
        velocity_offset: ArrayLike,
        deceleration_limit: ArrayLike,
        tau_max: ArrayLike,
        rate_max: ArrayLike,
        dt: float,
    ) -> None:
        values = (q_min, q_max, v_max, velocity_offset, deceleration_limit, tau_max, rate_max)
        arrays = (np.array(each, dtype=float) for each in values)
        self._q_min, self._q_max, self._v_max, self._c, self._d, self._tau_max, rates = arrays
        self._step_max = rates * dt
        n = len(self._q_min)
        self.position, self.speed, self.torque, self.rate = np.zeros((4, n))
        self.lower, self.upper = np.full((2, n), np.inf)

    def update(self, q: Array, v: Array, tau: Array) -> None:
        """Judge a physics step.

        Args:
            q: positions, shape (n,), rad.
            v: velocities, shape (n,), rad/s.
            tau: torques that the motors are asked for, with gravity, shape (n,), N m.
        """
        low, high = q - self._q_min, self._q_max - q
        room = np.maximum(np.where(v < 0.0, low, high), 0.0)
        fastest = np.clip(np.sqrt(2.0 * self._d * room) - self._c, 0.0, self._v_max)
        np.minimum(self.lower, low, out=self.lower)
        np.minimum(self.upper, high, out=self.upper)
        np.maximum(self.position, -np.minimum(low, high), out=self.position)
        np.maximum(self.speed, np.abs(v) - fastest, out=self.speed)
        np.maximum(self.torque, np.abs(tau) / self._tau_max, out=self.torque)

    def sent(self, tau: Array, before: Array) -> None:
        """Judge a torque that the robot is sent, N m, by the one before it."""
        np.maximum(self.rate, np.abs(tau - before) / self._step_max, out=self.rate)

    @property
    def violated(self) -> bool:
        """Whether any limit was violated, torques and their rates by more than rounding."""
        kept = (
            (self.position <= 0.0)
            & (self.speed <= 0.0)
            & (self.torque <= 1.0 + 1e-9)
            & (self.rate <= 1.0 + 1e-9)
        )
        return not bool(kept.all())
