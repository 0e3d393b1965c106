# SPDX-License-Identifier: Apache-2.0
"""The topic of the simulated force/torque sensor, with bias and noise."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from geometry_msgs.msg import WrenchStamped
from numpy.typing import NDArray
from rclpy.node import Node

from sim_bridge.bullet.robot import BulletRobot
from viability_bounds_pkg.exceptions import SettingError
from viability_bounds_pkg.ros.parameters import (
    FINITE,
    NOT_NEGATIVE,
    Parameter,
    Range,
    given_or,
)
from viability_bounds_pkg.ros.runtime import set_stamp
from viability_bounds_pkg.ros.topics import FT_WRENCH

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
    """The reading of a robot's sensor: the simulated wrench, bias and noise.

    Args:
        robot: with a sensor.
        config: of that sensor.
    """

    def __init__(self, robot: BulletRobot, config: SensorConfiguration) -> None:
        self._robot, self._config = robot, config
        self.restart()

    def restart(self) -> None:
        """Restart the noise from its seed."""
        self._random = np.random.default_rng(self._config.seed)

    def read(self) -> Array:
        """Return force and moment, shape (6,), N and N m, with new noise."""
        noise = self._config.noise * self._random.standard_normal(6)
        return self._robot.sensor_wrench() + self._config.bias + noise


class ForceTorquePublisher:
    """Publishes ``ft_wrench``.

    Args:
        node: publishes.
        robot: with a sensor.
        config: of that sensor.
    """

    def __init__(self, node: Node, robot: BulletRobot, config: SensorConfiguration) -> None:
        self._reading = ForceTorqueReading(robot, config)
        self._message = WrenchStamped()
        self._message.header.frame_id = config.frame
        self._publisher = FT_WRENCH.publisher(node)

    def restart(self) -> None:
        """Restart the noise from its seed."""
        self._reading.restart()

    def publish(self, stamp: int) -> None:
        """Publish a reading with `stamp`, ns."""
        message = self._message
        set_stamp(message.header.stamp, stamp)
        force, torque = message.wrench.force, message.wrench.torque
        wrench = self._reading.read().tolist()
        force.x, force.y, force.z, torque.x, torque.y, torque.z = wrench
        self._publisher.publish(message)

    def repeat(self) -> None:
        """Publish the last message again."""
        self._publisher.publish(self._message)
