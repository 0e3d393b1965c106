# SPDX-License-Identifier: Apache-2.0
"""Motors with a bandwidth and errors of their torque.

With the torque u that the drive is asked for, the torque T that it believes to give follows

    T' = omega (u - T).

u is constant in a physics step of length h, so that at the end of the step, and on average,

    T+ = u + (T - u) exp(-omega h),    T_mean = u + (T - u) (1 - exp(-omega h)) / (omega h).

The mean accelerates the joints in the step: then a joint's velocity changes by the integral of T,
and v + T / (omega I) by that of u, without an error of the discretisation. The true torque is

    tau = clip((1 + e) T_mean + r tau_max sin(N q) + n, -tau_max, tau_max)

with an error e of the torque constant, ripple of amplitude r, N periods a turn, and noise n of the
current.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from sim_bridge.hardware.imperfections import Imperfections
from sim_bridge.hardware.noise import ClippedNoise, Stream

Array = NDArray[np.float64]

RIPPLE_PERIODS = 200
"""Of the ripple in one turn of a joint: a harmonic drive's torque has two in each turn of its
motor, and a gear ratio of 100 is assumed."""


class Motors:
    """The motors of n joints.

    They are off after a reset and while the brakes hold. When they are switched on, their torque
    is at once what is asked for: the brakes are opened when the motors carry the load.

    Args:
        imperfections: which ones there are.
        torque_max: torque limits, shape (n,), N m; no torque is beyond them, errors included.
        physics_dt: the physics step, s.

    Attributes:
        believed: torque that the drives believe to give, at the end of the last physics step,
            shape (n,), N m; None while they are off.
    """

    def __init__(self, imperfections: Imperfections, torque_max: Array, physics_dt: float) -> None:
        given = imperfections
        x = 2.0 * math.pi * given.motor_bandwidth * physics_dt
        lag = x > 0.0
        self._decay = np.where(lag, np.exp(-x), 0.0)
        self._mean = np.where(lag, -np.expm1(-x) / np.where(lag, x, 1.0), 0.0)
        self._gain = 1.0 + given.torque_constant_error
        self._ripple = given.torque_ripple * torque_max
        self._noise = ClippedNoise(
            given.current_noise * torque_max, given.imperfection_seed, Stream.MOTOR_CURRENT
        )
        self._limit = torque_max
        self.believed: Array | None = None

    def reset(self) -> None:
        """Switch the motors off and begin the noise anew."""
        self._noise.reset()
        self.switch_off()

    def switch_off(self) -> None:
        """Switch the motors off."""
        self.believed = None

    def step(self, asked: Array, q: Array) -> Array:
        """Return the true torque in the next physics step, shape (n,), N m.

        Args:
            asked: torques that the drives are asked for, shape (n,), N m.
            q: positions of the joints, shape (n,), rad.
        """
        gap = (asked if self.believed is None else self.believed) - asked
        self.believed = asked + self._decay * gap
        mean = asked + self._mean * gap
        torque = self._gain * mean + self._ripple * np.sin(RIPPLE_PERIODS * q)
        return np.clip(self._noise.added_to(torque), -self._limit, self._limit)
