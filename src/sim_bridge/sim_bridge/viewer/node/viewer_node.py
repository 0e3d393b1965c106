# SPDX-License-Identifier: Apache-2.0
"""The viewer node: the arm on a page in the browser, and goals and pushes from there."""

from __future__ import annotations

import logging
import math
import os
import signal
import socket
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np
import pinocchio as pin
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, WrenchStamped
from rclpy.executors import SingleThreadedExecutor
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory

from sim_bridge.nodes.topics import EXTERNAL_WRENCH
from sim_bridge.viewer.joint_pictures import JointValues
from sim_bridge.viewer.node.driver import Driver, pose_of
from sim_bridge.viewer.node.settings import RemoteSettings
from sim_bridge.viewer.node.viewer_parameters import ViewerConfiguration
from sim_bridge.viewer.page import Page, Picture, SettingAsked
from sim_bridge.viewer.shapes import visual_shapes
from viability_bounds_pkg.exceptions import ArmSafetyError, SettingError
from viability_bounds_pkg.robot.configuration import load_model
from viability_bounds_pkg.robot.description import RobotDescriptionError
from viability_bounds_pkg.ros.arm_node import ArmNode
from viability_bounds_pkg.ros.messages import JointStateReader
from viability_bounds_pkg.ros.parameters import NodeParameters
from viability_bounds_pkg.ros.program import (
    initialise,
    leave,
    node_parser,
    report_refusal,
)
from viability_bounds_pkg.ros.robot_urdf import robot_urdf
from viability_bounds_pkg.ros.runtime import GOAL_QOS
from viability_bounds_pkg.ros.topics import (
    DIAGNOSTICS,
    FT_WRENCH,
    SLOW_ACCELERATION_LIMITS,
    SLOW_JOINT_STATES,
)

PERIOD = 0.05
"""Between two pictures, s."""
_SILENT = 1.0
"""How long without joint states until the page says so, s."""
_SHOWN = "bullet_node", "bounds_node", "controller_node"

_VIOLATIONS = {"position_violation_rad": "rad", "velocity_violation_rad_s": "rad/s"}


class ViewerNode(ArmNode):
    """Shows the arm in a browser: state, limits, goal and forces, and sends what the user asks.

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
        self._driver: Driver | None = None
        with self.starting():
            config = NodeParameters(self, ViewerConfiguration).configuration
            self.page = _make_page(config, robot_urdf(config, self))
        self._reader = JointStateReader(config.joints)
        n = len(config.joints)
        self._unknown = np.full(n, math.nan)
        self._limits = self._unknown, self._unknown
        self._before: tuple[int, Any] | None = None  # stamp, ns, and speeds in the last picture
        self._acceleration = self._unknown
        self._goal: pin.SE3 | None = None
        self._pushes: dict[str, Any] = {}
        self._felt: Any = None
        self._status: dict[str, tuple[str, dict[str, str]]] = {}
        self._driver = Driver(self, config)
        self._settings = RemoteSettings(self)
        SLOW_JOINT_STATES.subscription(self, self._on_state)
        SLOW_ACCELERATION_LIMITS.subscription(self, self._on_limits)
        if config.ft_frame:
            FT_WRENCH.subscription(self, self._on_wrench)
        DIAGNOSTICS.subscription(self, self._on_diagnostics)
        EXTERNAL_WRENCH.subscription(self, self._on_push)
        self.create_subscription(PoseStamped, "target_pose", self._on_goal, GOAL_QOS)
        self.get_logger().info(f"page at {self.page.address}")

    def destroy_node(self) -> None:
        """Close the page, too; what the user began to push is let go."""
        if self._driver is not None:
            self._driver.stop()
            self.page.close()
        super().destroy_node()

    def proceed(self) -> None:
        """Send what the user asked for, and show what is known."""
        for request in self.page.requests():
            if isinstance(request, SettingAsked):
                self._settings.choose(request.node, request.name, request.value)
            elif self._driver is not None:
                self._driver.take(request)
        self._settings.proceed()
        if self._reader.accepted == 0:
            self.page.say(self._words())
            return
        self.page.show(
            Picture(
                JointValues(
                    self._reader.q,
                    self._reader.v,
                    self._torques(),
                    self._mean_acceleration(),
                    *self._limits,
                ),
                self._goal,
                self._pushes,
                self._felt,
                self._words(),
                self._settings.values,
            )
        )

    def _torques(self) -> Any:
        tau = self._reader.effort()
        return self._unknown if tau is None else tau

    def _mean_acceleration(self) -> Any:
        """Return the change of the speeds since the last picture by robot time, rad/s^2."""
        now = self._reader.stamp, self._reader.v
        if self._before is None or now[0] < self._before[0]:
            self._before = now
        elif now[0] > self._before[0]:
            span = 1e-9 * (now[0] - self._before[0])
            self._acceleration, self._before = (now[1] - self._before[1]) / span, now
        return self._acceleration

    def _words(self) -> str:
        lines = []
        if time.monotonic() - self._reader.heard_at > _SILENT:
            if self._driver is not None and self._driver.robot_paused:
                return "the simulated robot is paused"
            lines.append("**`bounds_node` sends no joint states**")
        message, controller = self._status.get("controller_node", ("not heard", {}))
        lines.append(f"**controller**: {message}")
        if (short := controller.get("short_of_goal", "none")) != "none":
            lines.append(short)
        _, robot = self._status.get("bullet_node", ("", {}))
        beyond = [
            f"{max(map(float, robot[key].split())):.2g} {unit}"
            for key, unit in _VIOLATIONS.items()
            if robot.get(key)
        ]
        if beyond:
            lines.append("beyond a limit so far: " + ", ".join(beyond))
        if self._settings.refused:
            lines.append(f"refused: {self._settings.refused}")
        return "  \n".join(lines)

    def _on_state(self, message: JointState) -> None:
        self._reader.read(message, time.monotonic())

    def _on_limits(self, message: JointTrajectory) -> None:
        limits = [np.array(point.accelerations) for point in message.points]
        if len(limits) == 2 and all(each.shape == self._unknown.shape for each in limits):
            self._limits = limits[0], limits[1]

    def _on_wrench(self, message: WrenchStamped) -> None:
        f = message.wrench.force
        self._felt = np.array([f.x, f.y, f.z])

    def _on_push(self, message: WrenchStamped) -> None:
        f = message.wrench.force
        force = np.array([f.x, f.y, f.z])
        if np.isfinite(force).all() and force.any():
            self._pushes[message.header.frame_id] = force
        else:
            self._pushes.pop(message.header.frame_id, None)

    def _on_goal(self, message: PoseStamped) -> None:
        self._goal = pose_of(message)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            name = status.name.rpartition("/")[2]
            if name in _SHOWN:
                values = {value.key: value.value for value in status.values}
                self._status[name] = status.message, values
                if name == "bullet_node" and self._driver is not None:
                    self._driver.robot_paused = values.get("paused") == "True"


def _make_page(config: ViewerConfiguration, urdf: str) -> Page:
    model = load_model(config, urdf)
    for name in ("base_frame", "ft_frame"):
        frame = getattr(config, name)
        if frame and not model.existFrame(frame):
            raise SettingError(name, frame, "a frame of the URDF")
    hand = config.end_effectors[0]
    if not model.existFrame(hand):
        raise SettingError("end_effector_frame", hand, "a frame of the URDF")
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
        config.viewer_host,
        config.viewer_port,
        model,
        shapes,
        config.limits,
        config.torque_max,
        (config.base_frame, hand, config.ft_frame),
    )


def run(node: ViewerNode, ended: Callable[[], bool]) -> None:
    """Take messages and show pictures until `ended`.

    Between two pictures nothing is taken, so that of each stream only the newest message is read.
    """
    executor = SingleThreadedExecutor(context=node.context)
    executor.add_node(node)
    while not ended() and rclpy.ok(context=node.context):
        begin = time.monotonic()
        # Each call takes one message; goals and diagnostics of all nodes may wait.
        for _ in range(len(list(node.subscriptions)) + 10):
            executor.spin_once(timeout_sec=0.0)
        node.proceed()
        time.sleep(max(0.0, begin + PERIOD - time.monotonic()))
    executor.remove_node(node)


def _step_back() -> None:
    """Let all threads wait for the control, however few processors there are.

    A low priority is not enough: a picture that has begun would keep its processor for
    milliseconds. Not before the page is there: on a busy machine it would never be.
    """
    for thread in map(int, os.listdir("/proc/self/task")):
        with suppress(ProcessLookupError):  # one that has just ended
            os.sched_setscheduler(thread, os.SCHED_IDLE, os.sched_param(0))


def main(args: list[str] | None = None) -> int:
    """Serve the page until SIGINT or SIGTERM comes; return the exit code."""
    node = None
    try:
        initialise(node_parser(ViewerNode), args)
        signals: list[int] = []
        for each in (signal.SIGINT, signal.SIGTERM):
            signal.signal(each, lambda number, _: signals.append(number))
        node = ViewerNode()
        print(f"the arm is at {node.page.address}", flush=True)
        _step_back()
        run(node, lambda: bool(signals))
    except ArmSafetyError as error:
        report_refusal(error)
        return 1
    finally:
        leave(*filter(None, [node]))
    return 0


if __name__ == "__main__":
    sys.exit(main())
