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
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from viability_bounds_pkg.compiled import compiled
from viability_bounds_pkg.exceptions import ArmSafetyError

_TARE_TIME = 0.2  # s, of the mean that becomes the bias


class WrenchError(ArmSafetyError, ValueError):
    """A measurement, or a property of the sensor or the tool, that cannot be used."""


@dataclass(frozen=True)
class SensorSettings:
    """How measurements are taken.

    Attributes:
        filter_hz: cut-off frequency of the filter, Hz.
        timeout: how long without a measurement before the sensor counts as silent, s.
    """

    filter_hz: float = 30.0
    timeout: float = 0.05


class WrenchSensor:
    """Keeps the wrench of the environment on the hand.

    Args:
        placement: of the sensor's frame in the end effector's.
        tool: inertia of what is beyond the sensor, in the sensor's axes.
        gravity: in the URDF's root frame, shape (3,), m/s^2.
        settings: may be replaced between steps.

    Attributes:
        settings: as given.
        placement: as given.
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
        settings: SensorSettings | None = None,
    ) -> None:
        self.settings = settings or SensorSettings()
        self.placement = placement
        self.bias = np.zeros(6)
        self._action = np.ascontiguousarray(placement.toDualActionMatrix())
        self._R = np.ascontiguousarray(placement.rotation)
        self._weight = tool.mass * np.asarray(gravity, dtype=float)
        self._com = tool.lever.copy()
        self.start()
        # The first call compiles; let it be this one and not one in a control loop.
        self.receive(np.zeros(6))
        self.update(np.eye(3), 0.0)
        self.start()

    def start(self) -> None:
        """Forget what was measured; the bias stays."""
        self.wrench, self.rate = np.zeros(6), np.zeros(6)
        self.silent = True
        self._raw: np.ndarray | None = None
        self._age = math.inf
        self._filtered, self._mean = np.zeros(6), np.zeros(6)

    def receive(self, raw: ArrayLike) -> None:
        """Take a measurement, in the sensor's axes, shape (6,), N and N m, for the next `update`.

        Raises:
            WrenchError: it is something else; nothing has changed then.
        """
        raw = np.array(raw, dtype=float)
        if raw.shape != (6,) or not np.isfinite(raw).all():
            raise WrenchError("not six finite numbers")
        self._raw = raw

    def update(self, rotation: np.ndarray, elapsed: float) -> None:
        """Make the wrench of this control step.

        Args:
            rotation: of the end effector in the root frame, shape (3, 3).
            elapsed: time since the last step, s.
        """
        self._age += elapsed
        if self._raw is None:
            if self._age > self.settings.timeout and not self.silent:
                self.start()
            return
        time, self._age = self._age, 0.0
        if self.silent or not time > 0.0:
            time = math.inf
        self.wrench, self.rate = _measured(
            self._raw,
            np.ascontiguousarray(rotation),
            self._R,
            self._weight,
            self._com,
            self._action,
            self.bias,
            time,
            2.0 * math.pi * self.settings.filter_hz,
            self._filtered,
            self._mean,
        )
        self._raw, self.silent = None, False

    def tare(self) -> np.ndarray:
        """Take what is measured now, the tool's weight subtracted, for the bias; return it.

        The hand must touch nothing. It is the mean over some tenths of a second.

        Raises:
            WrenchError: the sensor is silent.
        """
        if self.silent:
            raise WrenchError("the force/torque sensor is silent")
        self.bias = self._mean.copy()
        self.wrench = self._action @ (self._filtered - self.bias)
        return self.bias


@compiled
def _measured(
    raw: np.ndarray,
    rotation: np.ndarray,
    R: np.ndarray,
    weight: np.ndarray,
    com: np.ndarray,
    action: np.ndarray,
    bias: np.ndarray,
    time: float,
    cut_off: float,
    filtered: np.ndarray,
    mean: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return wrench and rate, shape (6,) each; updates `filtered` and `mean`, shape (6,).

    Args:
        raw: measurement, shape (6,).
        rotation: of the end effector in the root frame, shape (3, 3).
        R: of the sensor in the end effector's frame, shape (3, 3).
        weight: of the tool in the root frame, shape (3,), N.
        com: its centre of mass in the sensor's axes, shape (3,), m.
        action: of the sensor's placement on wrenches, shape (6, 6).
        bias: shape (6,).
        time: since the last measurement, s; inf if there was none.
        cut_off: of the filter, rad/s.
        filtered: shape (6,).
        mean: shape (6,).
    """
    found = raw.copy()
    force = np.zeros(3)
    for i in range(3):
        for j in range(3):
            for k in range(3):
                force[i] += R[j, i] * rotation[k, j] * weight[k]
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        found[i] -= force[i]
        found[3 + i] -= com[j] * force[k] - com[k] * force[j]
    share = -math.expm1(-cut_off * time)
    mean_share = -math.expm1(-time / _TARE_TIME)
    change, clean = np.empty(6), np.empty(6)
    for i in range(6):
        step = share * (found[i] - filtered[i])
        filtered[i] += step
        mean[i] += mean_share * (found[i] - mean[i])
        change[i] = step / time
        clean[i] = filtered[i] - bias[i]
    wrench, rate = np.zeros(6), np.zeros(6)
    for i in range(6):
        for j in range(6):
            wrench[i] += action[i, j] * clean[j]
            rate[i] += action[i, j] * change[j]
    return wrench, rate
