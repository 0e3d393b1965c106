# SPDX-License-Identifier: Apache-2.0
"""Sends what the user of the viewer's page asks for."""

from __future__ import annotations

import numpy as np
from geometry_msgs.msg import PoseStamped
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.publisher import Publisher
from std_srvs.srv import SetBool

from sim_bridge.node.topics import EXTERNAL_WRENCH
from sim_bridge.viewer.page import DrivingAsked, GoalAsked, PushAsked, Request
from viability_bounds_pkg.ros.messages import pose_message, wrench_message
from viability_bounds_pkg.ros.runtime import GOAL_QOS

Array = NDArray[np.float64]


class PageCommands:
    """Publishes goals and pushes from the page; its publishers exist only while the user drives.

    So another node may send goals before and after: the controller holds the arm where two do.

    Args:
        node: publishes.
        base_frame: of goals.

    Attributes:
        robot_paused: whether there is a simulated robot that is paused.
    """

    def __init__(self, node: Node, base_frame: str) -> None:
        self._node, self._base_frame = node, base_frame
        self._poses: Publisher | None = None
        self._wrenches: Publisher | None = None
        self._pushed: set[str] = set()
        self.robot_paused = self._resumed = False
        self._pause = node.create_client(SetBool, "bullet_node/pause")

    def start(self) -> None:
        """Create the publishers; resume a simulated robot that is paused."""
        if self._poses is None:
            self._poses = self._node.create_publisher(PoseStamped, "target_pose", GOAL_QOS)
            self._wrenches = EXTERNAL_WRENCH.publisher(self._node)
        if self.robot_paused and not self._resumed and self._pause.service_is_ready():
            self._resumed = True
            self._pause.call_async(SetBool.Request(data=False))

    def stop(self) -> None:
        """End the pushes, destroy the publishers, and pause the robot if it was paused before."""
        for link in list(self._pushed):
            self._push(link, np.zeros(3))
        for each in (self._poses, self._wrenches):
            if each is not None:
                self._node.destroy_publisher(each)
        self._poses = self._wrenches = None
        if self._resumed:
            self._resumed = False
            self._pause.call_async(SetBool.Request(data=True))

    def send(self, request: Request) -> None:
        """Do what was asked for; goals and pushes only while driving."""
        if isinstance(request, DrivingAsked):
            (self.start if request.drive else self.stop)()
        elif isinstance(request, GoalAsked) and self._poses is not None:
            self._poses.publish(pose_message(request.pose, self._base_frame))
        elif isinstance(request, PushAsked):
            self._push(request.link, request.force)

    def _push(self, link: str, force: Array) -> None:
        if self._wrenches is None:
            return
        self._wrenches.publish(wrench_message(link, force))
        (self._pushed.add if force.any() else self._pushed.discard)(link)
