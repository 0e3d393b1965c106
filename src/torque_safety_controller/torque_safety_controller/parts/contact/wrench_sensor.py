# SPDX-License-Identifier: Apache-2.0
"""What a wrist force/torque sensor measures, made into the wrench of the environment on the hand.

A sensor feels everything beyond it: what the environment does to the hand, and the weight of the
hand, besides a bias of its own and noise. With R the orientation of the sensor and m, c mass and
centre of mass of what is beyond it,

    F = raw - (m R'g, c x m R'g) - bias,

taken to the end effector's origin and axes, and filtered by one time constant; the derivative is
that of the filtered wrench, the finite difference that [Benallegue2021] takes, without its noise.
"""

from __future__ import annotations

import math

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

from viability_bounds_pkg.exceptions import ArmSafetyError

Array = NDArray[np.float64]

STRONGEST = 1e5
"""Largest force or moment that is taken for one, N or N m: no arm bears more."""

FILTER_HZ = 30.0
"""Cut-off frequency of the wrench's filter."""

TIMEOUT = 0.05
"""How long without a measurement before force control ends, s."""

_TARE_TIME = 0.2  # s, of the mean that becomes the bias


class WrenchError(ArmSafetyError, ValueError):
    """A measurement, or a property of the sensor or the tool, that cannot be used."""


class WrenchSensor:
    """Keeps the wrench of the environment on the hand.

    Args:
        placement: of the sensor's frame in the end effector's.
        tool: inertia of what is beyond the sensor, in the sensor's axes.
        gravity: in the URDF's root frame, shape (3,), m/s^2.
        filter_hz: cut-off frequency of the filter, Hz.
        timeout: how long without a measurement before the sensor counts as silent, s.
        frame: name of the sensor's frame; empty where no load is to be expected.

    Attributes:
        placement, frame: as given.
        bias: of the sensor, in its axes, shape (6,), N and N m; see `tare`.
        wrench: of the environment on the arm, about the end effector's origin and in its axes,
            shape (6,), N and N m; zero while the sensor is silent.
        rate: its time derivative, shape (6,), N/s and N m/s.
        silent: whether there was no measurement for too long, or none yet.
    """

    def __init__(
        self,
        placement: pin.SE3,
        tool: pin.Inertia,
        gravity: ArrayLike,
        filter_hz: float = FILTER_HZ,
        timeout: float = TIMEOUT,
        frame: str = "",
    ) -> None:
        self._cut_off, self._timeout = 2.0 * math.pi * filter_hz, timeout
        self.placement, self.frame = placement, frame
        self.bias = np.zeros(6)
        self._action = np.ascontiguousarray(placement.toDualActionMatrix())
        self._tool = tool
        self.carry(pin.Inertia.Zero())
        self._gravity = np.asarray(gravity, dtype=np.float64)
        self.start()

    def carry(self, load: pin.Inertia) -> None:
        """Feel a load besides the tool from now on, in the sensor's axes."""
        beyond = self._tool + load
        # From gravity in the end effector's axes to the wrench of the weight.
        R = beyond.mass * self.placement.rotation.T
        self._weight = np.vstack([R, pin.skew(beyond.lever) @ R])  # shape (6, 3)

    def start(self) -> None:
        """Forget what was measured; the bias stays."""
        self.wrench, self.rate = np.zeros(6), np.zeros(6)
        self.silent = True
        self._raw: Array | None = None
        self._age = math.inf
        self._filtered, self._mean = np.zeros(6), np.zeros(6)

    def receive(self, raw: ArrayLike) -> None:
        """Take a measurement, in the sensor's axes, shape (6,), N and N m, for the next `update`.

        Raises:
            WrenchError: it is something else; nothing has changed then.
        """
        raw = np.array(raw, dtype=np.float64)
        numbers = raw.ravel().tolist()
        if raw.shape != (6,) or not all(map(math.isfinite, numbers)):
            raise WrenchError("not six finite numbers")
        if max(map(abs, numbers)) > STRONGEST:
            raise WrenchError(f"beyond {STRONGEST:g} N or N m")
        self._raw = raw

    def update(self, rotation: Array, elapsed: float) -> None:
        """Make the wrench of this control step.

        Args:
            rotation: of the end effector in the root frame, shape (3, 3).
            elapsed: time since the last step, s.
        """
        self._age += elapsed
        if self._raw is None:
            if self._age > self._timeout and not self.silent:
                self.start()
            return
        time, self._age = self._age, 0.0
        if self.silent or not time > 0.0:
            time = math.inf
        found = self._raw - self._weight @ self._gravity.dot(rotation)
        change = -math.expm1(-self._cut_off * time) * (found - self._filtered)
        self._filtered = self._filtered + change
        self._mean = self._mean - math.expm1(-time / _TARE_TIME) * (found - self._mean)
        self.wrench = self._action @ (self._filtered - self.bias)
        self.rate = self._action @ (change / time)
        self._raw, self.silent = None, False

    def tare(self) -> Array:
        """Take what is measured now, the tool's weight subtracted, for the bias; return it.

        The hand must touch nothing. It is the mean over some tenths of a second.

        Raises:
            WrenchError: the sensor is silent.
        """
        if self.silent:
            raise WrenchError("the force/torque sensor is silent")
        self.wrench = self.wrench + self._action @ (self.bias - self._mean)
        self.bias = self._mean.copy()
        return self.bias
