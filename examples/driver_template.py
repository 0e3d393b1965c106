# SPDX-License-Identifier: Apache-2.0
"""A driver for an arm: states out, commands in, a stop when commands fail.

Replace `StandIn` by the arm's library; `docs/start/your_robot.md` says what each part promises.
As it stands it runs, with ROS 2 Jazzy:

    python examples/driver_template.py --ros-args --params-file config/panda.yaml
    ros2 run torque_safety_controller safety_stack --ros-args --params-file config/panda.yaml
"""

import sys
import time
from collections import Counter
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from rclpy.executors import Executor
from sensor_msgs.msg import JointState

from viability_bounds_pkg.node.bounds_parameters import limits_of
from viability_bounds_pkg.parameter import NEGATIVE, POSITIVE, joint_numbers
from viability_bounds_pkg.robot import configuration as robot
from viability_bounds_pkg.robot.gravity import TorqueConvention, gravity_beyond
from viability_bounds_pkg.ros.arm_node import ArmNode
from viability_bounds_pkg.ros.messages import Array, CommandReader, TorqueCommand
from viability_bounds_pkg.ros.parameters import NodeParameters
from viability_bounds_pkg.ros.program import run
from viability_bounds_pkg.ros.runtime import set_stamp, stamp_to_ns
from viability_bounds_pkg.ros.topics import JOINT_COMMANDS, JOINT_STATES
from viability_bounds_pkg.stop import CoordinatedStop

WAIT, HELD = 0.7, 5  # share of a period that a command may take; periods for which it is held


@dataclass(frozen=True, eq=False, kw_only=True)
class DriverParameters(robot.ControlRate, TorqueConvention, robot.LimitedRobotConfiguration):
    """What the driver needs of the robot's parameter file."""

    start_positions: Array = joint_numbers("where the stand-in starts, rad")
    acceleration_min: Array = joint_numbers("lower limits of the stop, rad/s^2", NEGATIVE)
    acceleration_max: Array = joint_numbers("upper limits of the stop, rad/s^2", POSITIVE)


class StandIn:
    """REPLACE by calls of the arm's library: `read` waits for a period, `write` commands it."""

    def __init__(self, config: DriverParameters, model: pin.Model) -> None:
        self._model, self._data, self._dt = model, model.createData(), config.dt
        self._added = gravity_beyond(model, config.command_includes_gravity) or np.zeros_like
        self._hidden = gravity_beyond(model, config.effort_includes_gravity) or np.zeros_like
        self.q, self.v, self.tau = config.start_positions, *np.zeros((2, model.nv))
        self._stamp, self._due = time.time_ns(), 0.0

    def read(self) -> tuple[int, Array, Array, Array]:
        """Return time, ns, q, rad, v, rad/s, and the motors' torques, N m, in a new period."""
        time.sleep(max(0.0, self._due - time.monotonic()))
        self._stamp, self._due = self._stamp + round(1e9 * self._dt), time.monotonic() + self._dt
        return self._stamp, self.q, self.v, self.tau - self._hidden(self.q)

    def write(self, command: Array) -> None:
        """Apply torques, N m; an arm that adds those against gravity does it here."""
        h, self.tau = self._dt, command + self._added(self.q)
        a = pin.aba(self._model, self._data, self.q + 0.5 * h * self.v, self.v, self.tau)
        self.q, self.v = self.q + h * self.v + 0.5 * h * h * a, self.v + h * a


class Driver(ArmNode):
    """Publishes joint_states, obeys joint_commands, and stops the arm when they fail."""

    NAME, PARAMETERS = "driver", DriverParameters

    def __init__(self, **node_arguments: object) -> None:
        super().__init__(**node_arguments)
        with self.starting():  # a wrong parameter ends it with one line
            config = self._config = NodeParameters(self, DriverParameters).configuration
            model = robot.load_model(config, config.read_urdf())
            self._stop = CoordinatedStop(model, limits_of(config), config.torque_max, config.dt)
        self._gravity = gravity_beyond(model, config.command_includes_gravity) or np.zeros_like
        self.arm, self.wait = StandIn(config, model), WAIT * config.dt
        self._most, self._command, self._stamp = config.torque_max, np.zeros(model.nv), 0
        self._missed = HELD + 1  # until the first command the stop's law holds the arm
        self._states = self.stream(JOINT_STATES)
        self._reader = CommandReader(config.joints, Counter(), self.get_logger().warning)
        self.listen(JOINT_COMMANDS, self._on_command)
        self.announce(config.joints, config.rate_hz, "driver")

    def run_once(self, executor: Executor, *_: object) -> None:
        """Do a period: publish the state, wait for its command, apply torques."""
        self._stamp, *state = self.arm.read()
        q, v, effort = (each.tolist() for each in state)
        message = JointState(name=[*self._config.joints], position=q, velocity=v, effort=effort)
        set_stamp(message.header.stamp, self._stamp)
        self._missed, end = self._missed + 1, time.monotonic() + self.wait
        self._states.publish(message)
        while self._missed and (left := end - time.monotonic()) > 0.0:
            executor.spin_once(timeout_sec=left)
        self.arm.write(self._torque(*state[:2]) - self._gravity(state[0]))

    def _on_command(self, message: JointState) -> None:
        command = self._reader.read(message)  # None where it is invalid
        if stamp_to_ns(message.header.stamp) == self._stamp and isinstance(command, TorqueCommand):
            self._command, self._missed = command.tau, 0

    def _torque(self, q: Array, v: Array) -> Array:
        """Return what the motors are to give in all, N m, for a state, rad and rad/s."""
        command = np.clip(self._command + self._gravity(q), -self._most, self._most)
        if self._stop.returned and not self._missed:
            return command
        if self._stop.returned:
            self._stop.start(q, v)
        if self._missed <= HELD:
            return self._stop.follow(q, v, command)
        if self._missed == HELD + 1:
            self.get_logger().warning("no commands: the arm stops", throttle_duration_sec=10.0)
        return self._stop.torque(q, v)


if __name__ == "__main__":
    sys.exit(run(Driver))
