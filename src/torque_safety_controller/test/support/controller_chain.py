# SPDX-License-Identifier: Apache-2.0
"""The other side of the controller node, for tests: a robot and a bounds node."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory

from torque_safety_controller.controller import Controller
from torque_safety_controller.node.assembly import make_controller
from torque_safety_controller.node.controller_node import ControllerNode
from torque_safety_controller.parameters.controller_parameters import ControllerConfiguration
from torque_safety_controller.tasks.gains import Gains, critical_damping
from viability_bounds_pkg.parameter import parameter_table, read
from viability_bounds_pkg.ros.topics import state_topic
from viability_bounds_pkg.testing.ros_harness import (
    RosHarness,
    acceleration_limits,
    joint_state,
    read_config,
)

MS = 1_000_000
NODE = "controller_node"


def patient_values(robot: str, **changed: Any) -> dict[str, Any]:
    """Return a robot's parameters, with watchdogs that do not bark while other tests run."""
    return read_config(robot, NODE) | {"bounds_timeout": 20.0, "state_timeout": 40.0} | changed


def gains_of(values: Mapping[str, Any]) -> Gains:
    """Return the gains that the node makes of its parameters."""
    return Gains(
        pose_error=values.get("pose_error", "separate"),
        pose_kp=values["pose_kp"],
        pose_kd=critical_damping(values["pose_kp"]),
        pose_weight=values["pose_weight"],
        posture_kp=values["posture_kp"],
        posture_kd=critical_damping(values["posture_kp"]),
        posture_weight=values["posture_weight"],
        hold_kd=values["hold_kd"],
    )


def controller_of(values: Mapping[str, Any]) -> Controller:
    """Return the controller that the node makes of its parameters, without the node."""
    known = {row.name for row in parameter_table(ControllerConfiguration)}
    own = {name: value for name, value in values.items() if name in known}
    return make_controller(read(ControllerConfiguration, own))[0]


class ControllerChain:
    """A controller node, and what talks to it.

    Args:
        ros: harness.
        values: parameters of the node.

    Attributes:
        node: under test.
        commands: heard from it.
        joints: names.
        states: publisher of joint states.
        limits: publisher of acceleration limits.
    """

    def __init__(self, ros: RosHarness, values: Mapping[str, Any]) -> None:
        self.ros = ros
        self.joints = list(values["joints"])
        self.node = ros.start(ControllerNode, values)
        self.commands = ros.listen(JointState, "joint_commands")
        self.states = ros.talk(
            JointState, state_topic(bool(values.get("use_estimated_states"))).name
        )
        self.limits = ros.talk(JointTrajectory, "acceleration_limits")
        ros.hears("joint_commands")

    def send_state(self, stamp: int, q, v, tau=None) -> None:
        """Publish a state with a stamp in ms; without `tau` the motors are off."""
        tau = [0.0] * len(self.joints) if tau is None else tau
        self.states.publish(joint_state(self.joints, stamp * MS, q, v, tau))

    def send_limits(self, stamp: int, lower, upper) -> None:
        """Publish acceleration limits with a stamp in ms."""
        self.limits.publish(acceleration_limits(self.joints, stamp * MS, lower, upper))

    def await_command(self, stamp: int, each: Callable[[], None] | None = None) -> JointState:
        """Wait for the command with a stamp, ms."""
        self.ros.wait_until(
            lambda: stamp * MS in self.commands.stamps, f"a command for {stamp}", each=each
        )
        return self.commands[self.commands.stamps.index(stamp * MS)]

    def ask(self, stamp: int, q, v, lower=-50.0, upper=50.0, tau=None) -> JointState:
        """Send a state and its limits, rad/s^2, until the command comes; return that."""
        n = len(self.joints)

        def send() -> None:
            self.send_limits(stamp, np.broadcast_to(lower, n), np.broadcast_to(upper, n))
            self.send_state(stamp, q, v, tau)

        return self.await_command(stamp, send)

    def await_goals(self, count: int = 1) -> None:
        """Wait until so many goals have come that no state has brought into effect yet."""
        self.ros.wait_until(lambda: self.reported("goals_pending") == str(count), "the goals")

    def reported(self, key: str) -> str:
        """Return a value of the node's last diagnostics, or the empty string."""
        return self.ros.reported(NODE, key)
