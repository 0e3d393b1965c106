# SPDX-License-Identifier: Apache-2.0
"""Bumpless handover between the robot's position control and torque control.

[Benallegue2021], IV-A: the position reference is captured and held while the QP computes its
first torque for the present configuration; from the next step on torque is commanded. The
integral action starts with the difference between the measured and the computed torque, so that
the commanded torque is continuous (`Controller.resume`). The measured torque is an
average: positions are held until it is known well enough.

Position-controlled drives stop a moving arm as hard as they can. On the way back the arm is
therefore first brought to rest under torque control.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from viability_bounds_pkg.exceptions import ArmSafetyError

Array = NDArray[np.float64]

TORQUE_TOLERANCE = 0.01
"""Share of its limit by which a measured torque may exceed it; the torque step is no larger."""

TORQUE_ERROR = 0.005
"""Share of its limit by which the averaged torque of a motor may be off at the handover."""

FEWEST = 10
"""Samples of which the spread is believed."""

AVERAGING_TIME = 1.0
"""Longest time that the torque of the motors is averaged over, s."""

PATIENCE = 2.0
"""Longest time to wait for the torque of the motors to be known, s."""


class HandoverRefused(ArmSafetyError, ValueError):
    """A change of control that is not possible now; the text says why."""


class MotorTorque(NamedTuple):
    """Torque of the motors as it is known.

    Attributes:
        mean: without noise, shape (n,), N m.
        error: how far it may be off, shape (n,), share of the torque limits.
        samples: how many say so.
    """

    mean: Array
    error: Array
    samples: int


class Handover:
    """Position that the drives hold, and the torque that torque control continues.

    Args:
        joints: names of the n joints.
        q_min: lower position limits, shape (n,), rad.
        q_max: upper position limits, shape (n,), rad.
        tau_max: torque limits, shape (n,), N m.
        dt: control period, s.
    """

    def __init__(
        self,
        joints: tuple[str, ...],
        q_min: ArrayLike,
        q_max: ArrayLike,
        tau_max: ArrayLike,
        dt: float,
    ) -> None:
        self._joints, self._dt = joints, dt
        self._q_min, self._q_max = np.asarray(q_min), np.asarray(q_max)
        self._tau_max = np.asarray(tau_max)
        self._samples: list[Array] = []
        self._most, self._waited = max(FEWEST, round(AVERAGING_TIME / dt)), 0.0
        self._q_hold: Array | None = None

    def hold(self, q: Array) -> Array:
        """Return the position to hold, captured at the first call.

        Args:
            q: position now, shape (n,), rad.
        """
        if self._q_hold is None:
            self._q_hold = q.copy()
        return self._q_hold

    def release(self) -> None:
        """Forget the position that is held: the arm moves, or may have been put elsewhere."""
        self._q_hold = None

    def start(self, q: Array, tau: Array | None) -> None:
        """Begin to average the torque of the motors.

        Args:
            q: position, shape (n,), rad.
            tau: torque of the motors, shape (n,), N m; None if it is not measured.

        Raises:
            HandoverRefused: torque control would not be safe, or not smooth.
        """
        self._within_limits(self._measured(q, tau))
        self._samples, self._waited = [], 0.0

    def torque(self, q: Array, tau: Array | None) -> MotorTorque | None:
        """Return the torque that torque control can begin with, or None if it is to wait.

        To be called with each state.

        Args:
            q: position, shape (n,), rad.
            tau: torque of the motors, shape (n,), N m; None if it is not measured.

        Raises:
            HandoverRefused: it cannot begin.
        """
        self._samples = [*self._samples[-self._most + 1 :], self._measured(q, tau)]
        self._waited += self._dt
        known = self._average()
        worst = int(np.argmax(known.error))
        if known.error[worst] <= TORQUE_ERROR:
            self._within_limits(known.mean)
            return known
        if self._waited > PATIENCE:
            raise HandoverRefused(
                f"after {PATIENCE:g} s the torque of {self._joints[worst]} is known to "
                f"{known.error[worst]:.2%} of torque_max only, by noise or motion; allowed: "
                f"{TORQUE_ERROR:.2%}"
            )
        return None

    def _average(self) -> MotorTorque:
        """Return where a line through as many of the last samples ends as say it best.

        It is off by three standard deviations of that end: many samples take noise out, and few
        of them know nothing of what moved the torque before.
        """
        seen, count = np.array(self._samples), len(self._samples)
        best = MotorTorque(seen[-1], np.full(self._tau_max.size, math.inf), count)
        size = FEWEST
        while size <= count:
            last, time = seen[-size:], np.arange(size) - 0.5 * (size - 1)
            mean, slope = last.mean(axis=0), time @ last / (time @ time)
            noise = (last - mean - np.outer(time, slope)).std(axis=0)
            end = math.sqrt(1.0 / size + time[-1] ** 2 / (time @ time))
            error = 3.0 * end * noise / self._tau_max
            if error.max() < best.error.max():
                best = MotorTorque(mean + slope * time[-1], error, size)
            size *= 2
        return best

    def _measured(self, q: Array, tau: Array | None) -> Array:
        outside = (q < self._q_min) | (q > self._q_max)
        if outside.any():
            raise HandoverRefused(f"outside the position limits: {self._names(outside)}")
        if tau is None:
            raise HandoverRefused("joint_states carry no motor torque (effort)")
        return tau

    def _within_limits(self, tau: Array) -> None:
        beyond = np.abs(tau) > (1.0 + TORQUE_TOLERANCE) * self._tau_max
        if beyond.any():
            raise HandoverRefused(f"motor torque beyond torque_max: {self._names(beyond)}")

    def _names(self, flags: NDArray[np.bool_]) -> str:
        return ", ".join(name for name, flag in zip(self._joints, flags, strict=True) if flag)
