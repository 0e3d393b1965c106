# SPDX-License-Identifier: Apache-2.0
"""The stream of commands: which one acts, and which are late or refused."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import JointState

from viability_bounds_pkg.recent_values import RecentValues
from viability_bounds_pkg.ros.messages import CommandReader, JointCommand, TorqueCommand
from viability_bounds_pkg.ros.runtime import stamp_to_ns

Array = NDArray[np.float64]

_STRAYS = 50
"""Commands in a row for other periods after which a warning is logged."""
_WARNING_PERIOD = 10.0
"""Least time between two warnings of a kind, s."""


class Driven(Protocol):
    """Parameters of a robot that obeys commands."""

    @property
    def joints(self) -> Sequence[str]:
        """Names of the n joints."""

    @property
    def dt(self) -> float:
        """Control period, s."""

    @property
    def torque_max(self) -> Array:
        """Torque limits of the motors, shape (n,), N m."""

    @property
    def command_timeout(self) -> int:
        """Control periods for which the last command is held."""


class Path(Protocol):
    """The way of commands to the drives, one in each control period.

    Attributes:
        absent: whether none had come for the last period.
        delay: periods after which commands act.
        missed: number of commands lost on purpose.
    """

    absent: bool
    delay: int
    missed: int

    def send(self, command: JointCommand, age: int = 0) -> bool:
        """Add a command that answers a state `age` periods old; return whether it can act."""

    def due(self) -> JointCommand | None:
        """Return the command that acts in the next period; None if there is none."""


class DirectPath:
    """A path on which each command acts in the period of the state that it answers."""

    delay = missed = 0

    def __init__(self) -> None:
        self._command: JointCommand | None = None
        self.absent = True

    def send(self, command: JointCommand, age: int = 0) -> bool:
        """Add the command of this period; return whether it is the first one."""
        if age or self._command is not None:
            return False
        self._command = command
        return True

    def due(self) -> JointCommand | None:
        """Return the command of this period, which ends."""
        command, self._command = self._command, None
        self.absent = command is None
        return command


class CommandStream:
    """Selects the command that acts in each period; counts missed, late and refused ones.

    Args:
        config: of the robot.
        refused: counts messages that are dropped, by reason.
        warn: logs a warning, as a logger of rclpy does.
        asked: returns the torque that a command asks the motors for, shape (n,), N m.
        make_path: makes the way of the commands to the drives.

    Attributes:
        acting: the command of the present period; None if the robot stops itself.
        commanded: whether there has been a command.
        missed: periods for which none had come.
        missed_in_row: periods since the last one that arrived.
        torque_ratio: largest commanded torque, as a share of its limit.
        path: delays and drops commands.
        latencies: times from states to their commands, s.
    """

    def __init__(
        self,
        config: Driven,
        refused: Counter[str],
        warn: Callable[..., object],
        asked: Callable[[Array], Array],
        make_path: Callable[[], Path] = DirectPath,
    ) -> None:
        self._config, self._refused, self._asked = config, refused, asked
        self._warn, self._make_path = warn, make_path
        self._reader = CommandReader(config.joints, refused, warn)
        self._dt_ns = round(1e9 * config.dt)
        self._resumed_after = -1
        self.restart()

    def restart(self) -> None:
        """Forget all commands, and count anew."""
        self.path = self._make_path()
        self.acting: JointCommand | None = None
        self.commanded = False
        self.missed_in_row = self.missed = self._strays = 0
        self.torque_ratio = 0.0
        self.latencies = RecentValues()

    def resume(self, stamp: int) -> None:
        """Obey after a pause no command that answers a state up to a stamp, ns, of before."""
        self._resumed_after = stamp

    def accept(
        self, message: JointState, stamp: int, published_at: float, *, ended: bool, paused: bool
    ) -> bool:
        """Check a message, and keep its command until it acts.

        Args:
            message: that has come.
            stamp: of the present period, ns.
            published_at: when its state was published, s on the steady clock.
            ended: whether the period has been simulated.
            paused: whether no command is obeyed.

        Returns:
            Whether it is the command for this period.
        """
        own = stamp_to_ns(message.header.stamp)
        age, rest = divmod(stamp - own, self._dt_ns)
        if paused or own <= self._resumed_after:
            return False
        if rest or not 0 <= age <= self.path.delay:
            self._count_stray(own, stamp)
            return False
        command = self._read(message)
        if command is None:
            return False
        if not self.path.send(command, age + ended):
            self._count_stray(own, stamp)
            return False
        self._strays = 0
        self.latencies.add(time.monotonic() - published_at + age * self._config.dt)
        return bool(age == 0)

    def proceed(self) -> None:
        """Apply the command that is due in the present period, or hold the last one."""
        arrived = self.path.due()
        if arrived is not None:
            self.acting, self.commanded = arrived, True
            self.missed_in_row = 0
        elif self.acting is not None:
            self.missed += self.path.absent
            self.missed_in_row += 1
            if self.missed_in_row > self._config.command_timeout:
                self.acting = None
                self._warn(
                    f"no command for {self.missed_in_row} periods: stopping until they are back",
                    throttle_duration_sec=_WARNING_PERIOD,
                )

    def _read(self, message: JointState) -> JointCommand | None:
        command = self._reader.read(message)
        if isinstance(command, TorqueCommand):
            share = np.abs(self._asked(command.tau)) / self._config.torque_max
            self.torque_ratio = max(self.torque_ratio, *share.tolist())
        return command

    def _count_stray(self, own: int, stamp: int) -> None:
        """Count a command that is not for this period; warn when no other comes."""
        self._refused["not for this period"] += 1
        self._strays += 1
        if self._strays == _STRAYS:
            self._warn(
                f"joint_commands refused: {_STRAYS} in a row do not have the stamp of the present "
                f"joint state; the last one has {1e-9 * own:.13g} s instead of "
                f"{1e-9 * stamp:.13g} s",
                throttle_duration_sec=_WARNING_PERIOD,
            )
