# SPDX-License-Identifier: Apache-2.0
"""The bias and noise of the simulated force/torque sensor, and its parameters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_bridge.bullet.force_torque_sensor import ForceTorqueSensor
from viability_bounds_pkg.exceptions import SettingError
from viability_bounds_pkg.ros.parameters import (
    FINITE,
    NOT_NEGATIVE,
    Parameter,
    Range,
    given_or,
)

Array = NDArray[np.float64]

SENSOR_TABLE = (
    Parameter("ft_frame", str, "link that is a force/torque sensor; none if empty", default=""),
    Parameter(
        "ft_bias",
        list[float],
        "bias of the sensor, force and moment, N and N m; none if empty",
        default=np.zeros(0),
        length=6,
        within=FINITE,
    ),
    Parameter(
        "ft_noise",
        list[float],
        "standard deviation of its noise, force and moment, N and N m; none if empty",
        default=np.zeros(0),
        length=6,
        within=NOT_NEGATIVE,
    ),
    Parameter("ft_seed", int, "seed of that noise", default=0, within=Range(0, 2**31 - 1)),
)


@dataclass(frozen=True)
class SensorConfiguration:
    """A force/torque sensor.

    Attributes:
        frame: its link; empty if there is none.
        bias: force and moment, shape (6,), N and N m.
        noise: standard deviation of force and moment, shape (6,), N and N m.
        seed: of the noise.
    """

    frame: str
    bias: Array
    noise: Array
    seed: int


def sensor_configuration(values: Mapping[str, Any]) -> SensorConfiguration:
    """Check parameter values.

    Raises:
        SettingError: a value cannot be used.
    """
    for name in ("ft_bias", "ft_noise"):
        if len(values[name]) and not values["ft_frame"]:
            allowed = "only with a force/torque sensor, 'ft_frame'"
            raise SettingError(name, values[name], allowed)
    bias, noise = (given_or(values, name, np.zeros(6)) for name in ("ft_bias", "ft_noise"))
    return SensorConfiguration(values["ft_frame"], bias, noise, values["ft_seed"])


class ForceTorqueReading:
    """The reading of a sensor: the simulated wrench, bias and noise.

    Args:
        sensor: of a robot.
        config: of that sensor.
    """

    def __init__(self, sensor: ForceTorqueSensor, config: SensorConfiguration) -> None:
        self._sensor, self._config = sensor, config
        self._random = np.random.default_rng(config.seed)

    def read(self) -> Array:
        """Return force and moment, shape (6,), N and N m, with new noise."""
        noise = self._config.noise * self._random.standard_normal(6)
        return self._sensor.wrench + self._config.bias + noise
