# SPDX-License-Identifier: Apache-2.0
"""The viewer node: shows the arm on a page in the browser, and sends goals and pushes from it."""

from __future__ import annotations

import logging
import math
import os
import socket
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pinocchio as pin
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from numpy.typing import NDArray
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory

from sim_bridge.node.page_commands import PageCommands
from sim_bridge.viewer.joint_pictures import JointValues
from sim_bridge.viewer.page import Page
from sim_bridge.viewer.shapes import visual_shapes
from viability_bounds_pkg.exceptions import SettingError
from viability_bounds_pkg.joint_limits import JointLimits
from viability_bounds_pkg.node.bounds_parameters import BoundsConfiguration, limits_of
from viability_bounds_pkg.parameter import Range, redeclared, text, whole_number
from viability_bounds_pkg.robot.configuration import (
    LimitedRobotConfiguration,
    TaskFrames,
    load_model,
)
from viability_bounds_pkg.robot.description import frame_id
from viability_bounds_pkg.robot.files import RobotDescriptionError
from viability_bounds_pkg.robot.gravity import TorqueConvention, gravity_beyond
from viability_bounds_pkg.robot.locked_joints import LockedJoints
from viability_bounds_pkg.robot.payload import Payload
from viability_bounds_pkg.robot.urdf_joints import units_of
from viability_bounds_pkg.ros.arm_node import ArmNode
from viability_bounds_pkg.ros.messages import Arrival, JointStateReader
from viability_bounds_pkg.ros.parameters import NodeParameters
from viability_bounds_pkg.ros.program import node_parser, run_together
from viability_bounds_pkg.ros.robot_urdf import robot_urdf
from viability_bounds_pkg.ros.runtime import GOAL_QOS, steady_timer
from viability_bounds_pkg.ros.topics import (
    DIAGNOSTICS,
    SLOW_ACCELERATION_LIMITS,
    SLOW_JOINT_STATES,
)

Array = NDArray[np.float64]

PERIOD = 0.05
"""Time between two pictures, s."""
_SILENT = 1.0
"""Time without joint states after which the page says so, s."""
_STATUS_OLD = 5.0
"""Age from which a status no longer counts, s; they come twice a second."""
_VIOLATIONS = {"position_violation_rad": "", "velocity_violation_rad_s": "/s"}
"""Keys of the robot's diagnostics, and what follows the unit of a joint's position there."""
_MODES = {
    "TRACKING: goal": "follows its goal",
    "HOLD": "holds the arm",
    "POSITION": "leaves the arm to the robot's position control",
    "STOPPED": "sends nothing",
}
"""What the controller does, by the start of its status."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ViewerConfiguration(TaskFrames, LimitedRobotConfiguration):
    """Parameters of the viewer.

    Attributes:
        limits: of the joints.
    """

    effort_includes_gravity: bool = redeclared(TorqueConvention, "effort_includes_gravity")
    acceleration_min: Array = redeclared(BoundsConfiguration, "acceleration_min")
    acceleration_max: Array = redeclared(BoundsConfiguration, "acceleration_max")
    viewer_host: str = text("address of the page", default="127.0.0.1")
    viewer_port: int = whole_number(
        "port of the page; the next free one if it is taken",
        Range(1024, 65535),
        default=8080,
    )
    limits: JointLimits = field(init=False)

    def __post_init__(self) -> None:
        """Make the limits."""
        super().__post_init__()
        object.__setattr__(self, "limits", limits_of(self))


class ViewerNode(ArmNode):
    """Shows state, limits and goal of the arm in a browser, and sends what the user asks.

    It subscribes to slow copies of the streams, and shows 20 times a second what has come last, so
    that neither its cost nor that of the control grows with the rate of the robot. It publishes
    nothing before its user switches "drive the arm" on.

    Attributes:
        page: what is shown.
    """

    NAME = "viewer_node"
    PARAMETERS = ViewerConfiguration

    def __init__(self, **node_arguments: Any) -> None:
        super().__init__(**node_arguments)
        with self.starting():
            config = NodeParameters(self, ViewerConfiguration).configuration
            urdf = robot_urdf(config, self)
            model = load_model(config, urdf)
            self.page = _make_page(config, urdf, model)
            frames = config.end_effectors, config.base_frame
            self._locked = LockedJoints(config, urdf, model, Payload(model), *frames)
        self._units = units_of(urdf, config.joints)
        gravity = gravity_beyond(model, config.effort_includes_gravity)
        self._reader = JointStateReader(config.joints, warn=self._warn, gravity=gravity)
        self._unknown = np.full(len(config.joints), math.nan)
        self._limits = self._unknown, self._unknown
        self._before: tuple[int, Array] | None = None  # stamp, ns, and speeds in the last picture
        self._acceleration = self._unknown
        self._goal: pin.SE3 | None = None
        self._status: dict[str, tuple[float, str, dict[str, str]]] = {}
        self._base_frame = config.base_frame
        self._commands = PageCommands(self, config.base_frame)
        SLOW_JOINT_STATES.subscription(self, self._on_state)
        SLOW_ACCELERATION_LIMITS.subscription(self, self._on_limits)
        DIAGNOSTICS.subscription(self, self._on_diagnostics)
        self.create_subscription(PoseStamped, "target_pose", self._on_goal, GOAL_QOS)
        steady_timer(self, PERIOD, self.update_page)
        self.get_logger().info(f"page at {self.page.address}")

    def destroy_node(self) -> None:
        """End the user's pushes and close the page, too."""
        if hasattr(self, "_commands"):
            self._commands.stop()
            self.page.close()
        super().destroy_node()

    def update_page(self) -> None:
        """Send what the user asked for, and show what is known."""
        self._commands.robot_paused = self._told("bullet_node")[1].get("paused") == "True"
        for request in self.page.requests():
            self._commands.send(request)
        if self._reader.accepted == 0:
            self.page.show_text(self._status_text())
            return
        tau = self._reader.effort()
        joints = JointValues(
            self._reader.q,
            self._reader.v,
            self._unknown if tau is None else tau,
            self._mean_acceleration(),
            *self._limits,
        )
        self.page.show(joints, self._goal, self._status_text())

    def _mean_acceleration(self) -> Array:
        """Return the change of the speeds since the last picture by robot time, rad/s^2."""
        stamp, v = self._reader.stamp, self._reader.v
        if self._before is not None and stamp > self._before[0]:
            self._acceleration = (v - self._before[1]) / (1e-9 * (stamp - self._before[0]))
        if self._before is None or stamp != self._before[0]:
            self._before = stamp, v
        return self._acceleration

    def _told(self, name: str) -> tuple[str, dict[str, str]]:
        """Return message and values of the status of a node, if it was heard lately."""
        at, message, values = self._status.get(name, (-math.inf, "", {}))
        if time.monotonic() - at > _STATUS_OLD:
            return "is not heard", {}
        return message, values

    def _status_text(self) -> str:
        lines = []
        if time.monotonic() - self._reader.heard_at > _SILENT:
            if self._commands.robot_paused:
                return "the simulated robot is paused"
            why = ", ".join(self._reader.refused)
            refused = why and not self._reader.accepted
            lines.append(
                f"**joint states are refused: {why}**"
                if refused
                else "**`bounds_node` sends no joint states**"
            )
        message, _ = self._told("controller_node")
        for mode, words in _MODES.items():
            if message.startswith(mode):
                message = words + message.removeprefix(mode)
        lines.append(f"**The controller** {message}")
        _, robot = self._told("bullet_node")
        beyond = passed_limits(robot, self._units)
        # Not by rounding; what is no number counts.
        passed = [f"{value:.2g} {unit}" for unit, value in beyond.items() if not value <= 1e-9]
        if passed:
            lines.append(f"limits of joints were passed, by at most {', '.join(passed)}")
        elif beyond:
            lines.append("all limits of the joints were kept so far")
        return "  \n".join(lines)

    def _on_state(self, message: JointState) -> None:
        arrival = self._reader.read(message, time.monotonic())
        if arrival is not Arrival.REFUSED and self._locked.due(self._reader.stamp):
            self._locked.look(message.name, message.position, self._reader.stamp)

    def _on_limits(self, message: JointTrajectory) -> None:
        limits = [np.array(point.accelerations) for point in message.points]
        if len(limits) == 2 and all(each.shape == self._unknown.shape for each in limits):
            self._limits = limits[0], limits[1]

    def _on_goal(self, message: PoseStamped) -> None:
        # The controller refuses others, and keeps the goal that it has.
        if message.header.frame_id in ("", self._base_frame):
            self._goal = _pose(message) or self._goal

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            place, _, name = status.name.rpartition("/")
            if place == self.get_namespace().strip("/"):  # not of another arm
                values = {value.key: value.value for value in status.values}
                self._status[name] = time.monotonic(), status.message, values


def _pose(message: PoseStamped) -> pin.SE3 | None:
    """Return the pose in a message, None if it is invalid."""
    p, o = message.pose.position, message.pose.orientation
    numbers = np.array([p.x, p.y, p.z, o.x, o.y, o.z, o.w])
    length = np.linalg.norm(numbers[3:])
    if not np.isfinite(numbers).all() or length < 1e-6:
        return None
    numbers[3:] /= length
    return pin.XYZQUATToSE3(numbers)


def passed_limits(robot: Mapping[str, str], units: Sequence[str]) -> dict[str, float]:
    """Return by how much limits were passed at most, by unit: angles and ways are not compared.

    Args:
        robot: its diagnostics; nothing is known without them.
        units: of the joints' positions.
    """
    beyond: dict[str, float] = {}
    for key, per in _VIOLATIONS.items():
        for unit, value in zip(units, robot.get(key, "").split(), strict=False):
            before = beyond.get(unit + per, 0.0)
            beyond[unit + per] = float(np.maximum(before, float(value)))
    return beyond


def _make_page(config: ViewerConfiguration, urdf: str, model: pin.Model) -> Page:
    frames = config.base_frame, config.end_effectors[0]
    for name, frame in zip(("base_frame", "end_effector_frame"), frames, strict=True):
        try:
            frame_id(model, frame)
        except RobotDescriptionError as error:
            raise SettingError(name, frame, "a frame of the URDF") from error
    try:
        shapes = visual_shapes(urdf, model, config.locked)
    except RobotDescriptionError as error:
        raise SettingError("robot_description", config.robot_description, str(error)) from error
    logging.getLogger("websockets").setLevel(logging.ERROR)  # each browser that leaves
    try:
        # The server would wait for ever for an address that it cannot have.
        socket.create_server((config.viewer_host, 0)).close()
    except OSError as error:
        allowed = f"an address of this machine ({error.strerror})"
        raise SettingError("viewer_host", config.viewer_host, allowed) from error
    return Page(
        (config.viewer_host, config.viewer_port),
        model,
        shapes,
        config.limits,
        config.torque_max,
        frames,
        units_of(urdf, config.joints),
    )


def _lower_priority() -> None:
    """Give all threads idle priority, so that the control has precedence.

    A low priority is not enough: a picture that has begun would keep its processor for
    milliseconds. Not before the page is there: on a busy machine it would never be.
    """
    for thread in map(int, os.listdir("/proc/self/task")):
        with suppress(ProcessLookupError):  # one that has just ended
            os.sched_setscheduler(thread, os.SCHED_IDLE, os.sched_param(0))


def main(args: list[str] | None = None) -> int:
    """Serve the page until SIGINT or SIGTERM comes; return the exit code."""

    def make_nodes() -> Iterator[ArmNode]:
        node = ViewerNode()
        yield node
        print(f"the arm is at {node.page.address}", flush=True)
        _lower_priority()

    return run_together(node_parser(ViewerNode), make_nodes, args)


if __name__ == "__main__":
    sys.exit(main())
