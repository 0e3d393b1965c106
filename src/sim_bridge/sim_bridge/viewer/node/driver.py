# SPDX-License-Identifier: Apache-2.0
"""Publishes the goals and pushes that the user of the page asks for."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from geometry_msgs.msg import PoseStamped, WrenchStamped
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.publisher import Publisher
from std_srvs.srv import SetBool
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from sim_bridge.nodes.topics import EXTERNAL_WRENCH
from sim_bridge.viewer.node.viewer_parameters import ViewerConfiguration
from sim_bridge.viewer.page import DrivingAsked, GoalAsked, JointsAsked, PushAsked, Request
from viability_bounds_pkg.ros.messages import pose_message
from viability_bounds_pkg.ros.runtime import GOAL_QOS, set_stamp

_SLIDE = 0.5
"""Time of the motion to where a slider is, s; the controller's limits make it longer."""


class Driver:
    """Sends goals and pushes; a publisher is there only while its user drives.

    So another node may send goals before and after: the controller holds the arm where two do.

    Args:
        node: publishes.
        config: names of joints and frames.

    Attributes:
        robot_paused: whether there is a simulated robot that is paused.
    """

    def __init__(self, node: Node, config: ViewerConfiguration) -> None:
        self._node, self._config = node, config
        self._poses: Publisher | None = None
        self._trajectories: Publisher | None = None
        self._forces: Publisher | None = None
        self._pushed: set[str] = set()
        self.robot_paused = self._resumed = False
        self._pause = node.create_client(SetBool, "bullet_node/pause")

    def start(self) -> None:
        """Begin to publish; a simulated robot that a scenario has left paused goes on."""
        if self._poses is None:
            self._poses = self._node.create_publisher(PoseStamped, "target_pose", GOAL_QOS)
            self._trajectories = self._node.create_publisher(
                JointTrajectory, "target_joint_trajectory", GOAL_QOS
            )
            self._forces = EXTERNAL_WRENCH.publisher(self._node)
        if self.robot_paused and not self._resumed and self._pause.service_is_ready():
            self._resumed = True
            self._pause.call_async(SetBool.Request(data=False))

    def stop(self) -> None:
        """End the pushes, and publish no more; the arm keeps its last goal.

        A simulated robot that was paused is paused again: a scenario begins so.
        """
        for link in list(self._pushed):
            self._push(link, np.zeros(3))
        for each in (self._poses, self._trajectories, self._forces):
            if each is not None:
                self._node.destroy_publisher(each)
        self._poses = self._trajectories = self._forces = None
        if self._resumed:
            self._resumed = False
            self._pause.call_async(SetBool.Request(data=True))

    def take(self, request: Request) -> None:
        """Do what was asked for; goals and pushes only while driving."""
        if isinstance(request, DrivingAsked):
            (self.start if request.begin else self.stop)()
        elif isinstance(request, GoalAsked) and self._poses is not None:
            self._poses.publish(pose_message(request.pose, self._config.base_frame))
        elif isinstance(request, JointsAsked) and self._trajectories is not None:
            self._trajectories.publish(self._trajectory(request.q))
        elif isinstance(request, PushAsked):
            self._push(request.link, request.force)

    def _trajectory(self, q: NDArray[np.float64]) -> JointTrajectory:
        config = self._config
        point = JointTrajectoryPoint(positions=q.tolist())
        set_stamp(point.time_from_start, round(1e9 * _SLIDE))
        return JointTrajectory(joint_names=list(config.joints), points=[point])

    def _push(self, link: str, force: NDArray[np.float64]) -> None:
        if self._forces is None:
            return
        message = WrenchStamped()
        message.header.frame_id = link
        part = message.wrench.force
        part.x, part.y, part.z = map(float, force)
        self._forces.publish(message)
        (self._pushed.add if force.any() else self._pushed.discard)(link)


def pose_of(message: PoseStamped) -> pin.SE3 | None:
    """Return the pose in a message, None if it is none."""
    p, o = message.pose.position, message.pose.orientation
    numbers = np.array([o.x, o.y, o.z, o.w, p.x, p.y, p.z])
    length = np.linalg.norm(numbers[:4])
    if not np.isfinite(numbers).all() or length < 1e-6:
        return None
    rotation = pin.Quaternion(numbers[:4] / length).toRotationMatrix()
    return pin.SE3(rotation, numbers[4:])
