# SPDX-License-Identifier: Apache-2.0
"""Drives of the simulated robot: how they follow commands, and stop the arm without."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from sim_bridge.bullet.robot import BulletRobot
from sim_bridge.command_path import CommandPath
from sim_bridge.node.bullet_parameters import BulletConfiguration, make_stop
from viability_bounds_pkg.robot.configuration import load_model
from viability_bounds_pkg.robot.gravity import gravity_beyond
from viability_bounds_pkg.ros.commands import CommandStream
from viability_bounds_pkg.ros.messages import TorqueCommand

Array = NDArray[np.float64]


class Drives:
    """Moves a robot by its commands, by its own stop law, or by its brakes.

    Args:
        config: of the robot.
        robot: that is moved.
        refused: counts commands that are dropped, by reason.
        warn: logs a warning, as a logger of rclpy does.

    Attributes:
        commands: that come.
        braked: periods without a command.

    Raises:
        SettingError: limits that a physics step is too long for.
    """

    def __init__(
        self,
        config: BulletConfiguration,
        robot: BulletRobot,
        refused: Counter[str],
        warn: Callable[..., object],
    ) -> None:
        self._config, self._robot, self._stop = config, robot, make_stop(config)
        model = load_model(config, config.urdf)
        self._gravity = gravity_beyond(model, config.command_includes_gravity)
        self._not_reported = gravity_beyond(model, config.effort_includes_gravity)
        self.commands = CommandStream(
            config, refused, warn, self._asked, lambda: CommandPath(config.imperfections)
        )
        self.braked = 0

    def restart(self) -> None:
        """Forget all commands, and count anew."""
        self.commands.restart()
        self.braked = 0

    @property
    def control(self) -> str:
        """What moves or holds the robot."""
        if self.commands.acting is not None:
            return "torque" if isinstance(self.commands.acting, TorqueCommand) else "position"
        if self._stop is None or not self.commands.commanded:
            return "brakes"
        return "stopped" if self._stop.at_rest else "stopping"

    def reported(self, q: Array, tau: Array) -> Array:
        """Return the torques to report for those of the motors at positions, shape (n,) each."""
        return tau if self._not_reported is None else tau - self._not_reported(q)

    def advance(self, period: int) -> None:
        """Simulate a control period under the last command, or the robot's own law.

        Args:
            period: how many there were before.
        """
        config, robot, commands = self._config, self._robot, self.commands
        commands.proceed()
        command = commands.acting
        if not robot.finite:  # after a push beyond all measure: no law stops that
            robot.brake(config.substeps, config.torque_max)
        elif command is None:
            # No command can have arrived before the first one's delay.
            self.braked += period >= config.imperfections.command_delay
            if self._stop is not None and commands.commanded:
                robot.stop(self._stop, config.substeps)
            else:
                robot.brake(config.substeps, config.torque_max)
        elif isinstance(command, TorqueCommand):
            if self._stop is not None and (commands.missed_in_row or robot.returning):
                robot.follow(self._stop, self._given(command.tau), config.substeps)
            elif self._gravity is None:
                robot.step(self._given(command.tau), config.substeps)
            else:
                robot.step_by(lambda: self._given(command.tau), config.substeps)
        else:
            robot.move(*command, config.torque_max, config.velocity_max, config.substeps)

    def _asked(self, command: Array) -> Array:
        """Return the torque that a command asks the motors for now, shape (n,), N m."""
        return command if self._gravity is None else command + self._gravity(self._robot.state().q)

    def _given(self, command: Array) -> Array:
        """Return that torque within the limits of the motors, which they do not exceed."""
        most = self._config.torque_max
        return np.minimum(np.maximum(self._asked(command), -most), most)
