# SPDX-License-Identifier: Apache-2.0
"""The connection to the robot: libfranka's torque control, its errors in words."""

from __future__ import annotations

import socket
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray
from pylibfranka import (
    ActiveControlBase,
    FrankaException,
    NetworkException,
    RealtimeConfig,
    RealtimeException,
    Robot,
    RobotMode,
    RobotState,
    Torques,
)

from viability_bounds_pkg.exceptions import ArmSafetyError

Array = NDArray[np.float64]

_PORT = 1337  # of libfranka's commands

_REACH_TIMEOUT = 3.0
"""How long an address may take to answer, s; libfranka waits for a minute."""

_LOST_CONNECTION = "Net Exception"
"""What libfranka says after a `NetworkException`, as another error."""


class FrankaError(ArmSafetyError, RuntimeError):
    """The robot cannot be reached, refuses, or has ended the torque control."""


class NoRealTimeError(FrankaError):
    """The kernel is not for real time."""


@dataclass(frozen=True, eq=False)
class Behaviour:
    """What the robot is told before its torque control begins.

    Attributes:
        collision_torque: external joint torques at which it stops, shape (7,), N m.
        collision_force: external forces and torques at the hand, shape (6,), N and N m.
        end_effector: pose of the hand's frame in that of the flange.
        load: what the flange carries besides the tool that the robot knows, in its axes.
    """

    collision_torque: Array
    collision_force: Array
    end_effector: pin.SE3
    load: pin.Inertia


class FrankaArm:
    """A Franka arm, connected.

    Args:
        address: of the robot.
        real_time: whether libfranka refuses a kernel that is not for real time.

    Attributes:
        state: the last one read.
        in_turn: whether that is the one after the state read before.
        lost: periods under torque control whose states were not read.

    Raises:
        FrankaError: it cannot be reached, or libfranka cannot be used.
    """

    def __init__(self, address: str, real_time: bool) -> None:
        self._address = address
        self._config = RealtimeConfig.kEnforce if real_time else RealtimeConfig.kIgnore
        self._robot: Robot | None = None
        self._control: ActiveControlBase | None = None
        self.in_turn = True
        self.lost = 0
        self.state: RobotState = self.connect()

    @property
    def connected(self) -> bool:
        """Whether there is a connection."""
        return self._robot is not None

    @property
    def controlled(self) -> bool:
        """Whether torques are obeyed."""
        return self._control is not None

    @property
    def trouble(self) -> str:
        """Why the robot cannot be controlled as it is, in words; empty if it can be."""
        errors = str(self.state.current_errors).strip("[]").replace('"', "")
        if errors:
            return f"error {errors}"
        mode = self.state.robot_mode
        return "" if mode in (RobotMode.Idle, RobotMode.Move) else f"mode {mode.name}"

    def connect(self) -> RobotState:
        """Connect anew; return the state."""
        self._control = self._robot = None
        with self._faults():
            socket.create_connection((self._address, _PORT), _REACH_TIMEOUT).close()
            self._robot = Robot(self._address, self._config)
            self.state = self._robot.read_once()
        return self.state

    def start(self, behaviour: Behaviour) -> None:
        """Begin torque control: torques are to be written from now on."""
        with self._faults():
            robot = self._connected()
            torque, force = behaviour.collision_torque.tolist(), behaviour.collision_force.tolist()
            robot.set_collision_behavior(torque, torque, force, force)
            nominal = _pose(self.state.F_T_NE)
            robot.set_EE(_numbers((nominal.inverse() * behaviour.end_effector).homogeneous))
            load = behaviour.load
            robot.set_load(load.mass, load.lever.tolist(), _numbers(load.inertia))
            self._control = robot.start_torque_control()

    def read(self) -> RobotState:
        """Wait for the next state; return it."""
        with self._faults():
            if self._control is None:
                self.state = self._connected().read_once()
            else:
                self.state, passed = self._control.readOnce()
                periods = round(1e3 * passed.to_sec())
                self.in_turn = periods <= 1
                self.lost += max(0, periods - 1)
        return self.state

    def write(self, torque: Sequence[float], last: bool = False) -> None:
        """Send torques without gravity, N m, for the state read last; `last` ends the control."""
        command = Torques(torque)
        command.motion_finished = last
        with self._faults():
            if self._control is not None:
                self._control.writeOnce(command)
        if last:
            self._control = None

    def close(self) -> None:
        """Leave the robot, which holds itself then."""
        self._control = self._robot = None

    def recover(self) -> None:
        """Reset the robot's errors, or connect again."""
        if self._robot is None:
            self.connect()
        with self._faults():
            self._connected().automatic_error_recovery()
            self.state = self._connected().read_once()

    def _connected(self) -> Robot:
        if self._robot is None:
            raise FrankaError("there is no connection to the robot")
        return self._robot

    @contextmanager
    def _faults(self) -> Iterator[None]:
        """End the control at an error of libfranka, and the connection if it is lost."""
        try:
            yield
        except (OSError, FrankaException, RuntimeError) as error:
            self._control = None
            if isinstance(error, FrankaError):
                raise
            if isinstance(error, (OSError, NetworkException)) or _LOST_CONNECTION in str(error):
                self._robot = None
            said = " ".join(str(error).split()).removeprefix("libfranka: ")
            kind = NoRealTimeError if isinstance(error, RealtimeException) else FrankaError
            raise kind(said) from error


def _pose(columns: Sequence[float]) -> pin.SE3:
    """Return a pose that libfranka gives, by columns."""
    return pin.SE3(np.reshape(columns, (4, 4), order="F"))


def _numbers(matrix: Array) -> list[float]:
    """Return a matrix as libfranka takes it, by columns."""
    return np.ravel(matrix, order="F").tolist()


def flange_pose(state: RobotState) -> pin.SE3:
    """Return the pose of the flange in the robot's base."""
    return _pose(state.O_T_EE) * _pose(state.F_T_EE).inverse()
