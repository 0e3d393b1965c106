# SPDX-License-Identifier: Apache-2.0
"""The bias and noise of the simulated force/torque sensor, and its parameters."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim_bridge.bullet.force_torque_sensor import ForceTorqueSensor
from viability_bounds_pkg.exceptions import SettingError
from viability_bounds_pkg.parameter import (
    FINITE,
    NOT_NEGATIVE,
    Range,
    numbers,
    text,
    whole_number,
)

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False, kw_only=True)
class SensorConfiguration:
    """Parameters of a force/torque sensor."""

    ft_frame: str = text("link that is a force/torque sensor; none if empty", default="")
    ft_bias: Array = numbers(
        "bias of the sensor, force and moment, N and N m; none if empty",
        FINITE,
        length=6,
        if_empty=0.0,
    )
    ft_noise: Array = numbers(
        "standard deviation of its noise, force and moment, N and N m; none if empty",
        NOT_NEGATIVE,
        length=6,
        if_empty=0.0,
    )
    ft_seed: int = whole_number("seed of that noise", Range(0, 2**31 - 1), default=0)

    def __post_init__(self) -> None:
        """Check that there is no bias or noise without a sensor."""
        for name in ("ft_bias", "ft_noise"):
            if getattr(self, name).any() and not self.ft_frame:
                allowed = "only with a force/torque sensor, 'ft_frame'"
                raise SettingError(name, getattr(self, name), allowed)


class ForceTorqueReading:
    """The reading of a sensor: the simulated wrench, bias and noise.

    Args:
        sensor: of a robot.
        config: of that sensor.
    """

    def __init__(self, sensor: ForceTorqueSensor, config: SensorConfiguration) -> None:
        self._sensor, self._config = sensor, config
        self._random = np.random.default_rng(config.ft_seed)

    def read(self) -> Array:
        """Return force and moment, shape (6,), N and N m, with new noise."""
        noise = self._config.ft_noise * self._random.standard_normal(6)
        return self._sensor.wrench + self._config.ft_bias + noise
