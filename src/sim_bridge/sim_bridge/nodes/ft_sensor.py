# SPDX-License-Identifier: Apache-2.0
"""The topic of the simulated force/torque sensor, with bias and noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from geometry_msgs.msg import WrenchStamped
from numpy.typing import NDArray
from rclpy.node import Node

from sim_bridge.bullet.robot import BulletRobot
from viability_bounds_pkg.exceptions import SettingError
from viability_bounds_pkg.parameter import (
    FINITE,
    NOT_NEGATIVE,
    Range,
    numbers,
    text,
    whole_number,
)
from viability_bounds_pkg.ros.runtime import set_stamp
from viability_bounds_pkg.ros.topics import FT_WRENCH

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False, kw_only=True)
class SensorConfiguration:
    """Parameters of a force/torque sensor."""

    ft_frame: str = text("link that is a force/torque sensor; none if empty", default="")
    ft_bias: Array = numbers(
        "bias of the sensor, force and moment, N and N m; none if empty",
        FINITE,
        length=6,
        default=(),
    )
    ft_noise: Array = numbers(
        "standard deviation of its noise, force and moment, N and N m; none if empty",
        NOT_NEGATIVE,
        length=6,
        default=(),
    )
    ft_seed: int = whole_number("seed of that noise", Range(0, 2**31 - 1), default=0)

    def __post_init__(self) -> None:
        """Check that there is no bias or noise without a sensor."""
        for name in ("ft_bias", "ft_noise"):
            if len(getattr(self, name)) and not self.ft_frame:
                allowed = "only with a force/torque sensor, 'ft_frame'"
                raise SettingError(name, getattr(self, name), allowed)


class ForceTorqueReading:
    """The reading of a robot's sensor: the simulated wrench, bias and noise.

    Args:
        robot: with a sensor.
        config: of that sensor.
    """

    def __init__(self, robot: BulletRobot, config: SensorConfiguration) -> None:
        self._robot, self._seed = robot, config.ft_seed
        self._bias, self._noise = (
            value if len(value) else np.zeros(6) for value in (config.ft_bias, config.ft_noise)
        )
        self.restart()

    def restart(self) -> None:
        """Restart the noise from its seed."""
        self._random = np.random.default_rng(self._seed)

    def read(self) -> Array:
        """Return force and moment, shape (6,), N and N m, with new noise."""
        noise = self._noise * self._random.standard_normal(6)
        return self._robot.sensor_wrench() + self._bias + noise


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
        self._message.header.frame_id = config.ft_frame
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
