# SPDX-License-Identifier: Apache-2.0
"""Applies external wrenches and obstacles from messages at their time stamps."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from geometry_msgs.msg import WrenchStamped
from rclpy.node import Node
from visualization_msgs.msg import Marker, MarkerArray

from sim_bridge.bullet.obstacles import Obstacle, ObstacleError
from sim_bridge.bullet.robot import BulletRobot
from sim_bridge.node.topics import EXTERNAL_WRENCH, OBSTACLES
from viability_bounds_pkg.robot.files import RobotDescriptionError
from viability_bounds_pkg.ros.messages import wrench_numbers
from viability_bounds_pkg.ros.refusals import RefusalLog, stamp_fault
from viability_bounds_pkg.ros.runtime import stamp_to_ns

_SHAPES = {Marker.CUBE: "box", Marker.SPHERE: "sphere", Marker.CYLINDER: "cylinder"}
_REFUSED = (RobotDescriptionError, ObstacleError, ValueError)

AHEAD_MAX = 3600.0
"""Messages with stamps further ahead are of another clock, s: scenarios are sent whole."""

WAITING_MAX = 10_000
"""So many messages may wait for their time."""


class _Change(NamedTuple):
    """A change of the simulated world at a stamp, ns."""

    stamp: int
    topic: str
    link: str
    """The link of an external wrench, or the empty string."""
    apply: Callable[[], object]


class WorldSubscriber:
    """Subscribes to wrenches and obstacles, and applies them to a robot and its world.

    A message with a stamp of zero or in the past takes effect in the next control period, others
    in the first period that begins at or after their stamp. One that is more than `AHEAD_MAX`
    ahead is refused: it is of another clock.

    Args:
        node: subscribes, and logs refused messages.
        robot: that they act on.
        now: returns the robot's time, ns.
        wrench_timeout: duration of a wrench unless another message for its link has come or waits
            for its time, s of robot time.
        refused: counts the refused messages and publishers by topic.

    Attributes:
        wrench_ends: when the wrench on each link ends unless another message comes, ns.
    """

    def __init__(
        self,
        node: Node,
        robot: BulletRobot,
        now: Callable[[], int],
        wrench_timeout: float,
        refused: Counter[str],
    ) -> None:
        self._logger = node.get_logger()
        self._robot, self._now, self._refused = robot, now, refused
        self._wrench_timeout = round(1e9 * wrench_timeout)
        self._pending: list[_Change] = []
        self._refusals = RefusalLog(self._logger.warning)
        self.wrench_ends: dict[str, int] = {}
        for topic, callback in (
            (EXTERNAL_WRENCH, self._on_wrench),
            (OBSTACLES, self._on_obstacles),
        ):
            topic.subscription(node, callback, partial(self._refuse, topic.name))

    def __len__(self) -> int:
        """Return the number of messages that wait for their time."""
        return len(self._pending)

    def clear(self) -> None:
        """Remove all wrenches and obstacles, and discard the waiting messages."""
        self._pending.clear()
        self.wrench_ends.clear()
        self._robot.clear_wrenches()
        self._robot.obstacles.clear()

    def apply_due(self, stamp: int) -> None:
        """Apply the changes that are due in the control period that begins at `stamp`, ns."""
        while self._pending and self._pending[0].stamp <= stamp:
            change = self._pending.pop(0)
            try:
                change.apply()
            except _REFUSED as error:
                self._refuse(change.topic, error)
            if change.link:
                self.wrench_ends[change.link] = stamp + self._wrench_timeout
        if not self.wrench_ends:
            return
        planned = {change.link for change in self._pending}
        for link, end in list(self.wrench_ends.items()):
            if stamp >= end and link not in planned:
                self._robot.clear_wrenches(link)
                del self.wrench_ends[link]

    def _add(self, change: _Change) -> None:
        if fault := stamp_fault(change.stamp, self._now(), AHEAD_MAX):
            raise ValueError(fault)
        if len(self._pending) >= WAITING_MAX:
            raise ValueError(f"{WAITING_MAX} messages wait for their time already")
        self._pending.append(change)
        self._pending.sort(key=lambda pending: pending.stamp)

    def _on_wrench(self, message: WrenchStamped) -> None:
        link, wrench = message.header.frame_id, wrench_numbers(message)
        try:
            self._robot.link_pose(link)  # or it raises
            if not np.isfinite(wrench).all():
                raise ValueError("it is not finite")
            stamp = stamp_to_ns(message.header.stamp)
            apply = partial(self._robot.apply_wrench, link, *np.split(wrench, 2))
            self._add(_Change(stamp, "external_wrench", link, apply))
        except _REFUSED as error:
            self._refuse("external_wrench", error)

    def _on_obstacles(self, message: MarkerArray) -> None:
        for marker in message.markers:
            try:
                apply = self._obstacle_change(marker)
                self._add(_Change(stamp_to_ns(marker.header.stamp), "obstacles", "", apply))
            except _REFUSED as error:
                self._refuse("obstacles", error)

    def _obstacle_change(self, marker: Marker) -> Callable[[], object]:
        """Return the change that a marker describes.

        Raises:
            ObstacleError: an unknown action or shape, or an invalid obstacle.
            RobotDescriptionError: a frame that the robot does not have.
        """
        # Markers are told apart by both; scenarios give names alone.
        robot, name = self._robot, f"{marker.ns}/{marker.id}" if marker.id else marker.ns
        if marker.action == Marker.DELETEALL:
            return robot.obstacles.clear
        if marker.action == Marker.DELETE:
            return partial(self._remove, name)
        if marker.action != Marker.ADD or marker.type not in _SHAPES:
            raise ObstacleError(
                f"obstacle {name!r}: action {marker.action} with type {marker.type}; allowed: "
                "ADD (0) of CUBE (1), SPHERE (2), CYLINDER (3); DELETE (2); DELETEALL (3)"
            )
        p, o, s = marker.pose.position, marker.pose.orientation, marker.scale
        given = Obstacle(
            name, _SHAPES[marker.type], (s.x, s.y, s.z), (p.x, p.y, p.z), (o.x, o.y, o.z, o.w)
        )
        frame = marker.header.frame_id
        if not frame:
            return partial(robot.obstacles.add, given)
        robot.link_pose(frame)  # or it raises
        return lambda: robot.obstacles.add(_placed(given, robot.link_pose(frame)))

    def _remove(self, name: str) -> None:
        if not self._robot.obstacles.remove(name):
            raise ObstacleError(f"there is no obstacle {name!r}")

    def _refuse(self, topic: str, reason: Exception | str) -> None:
        """Count a refusal, and tell it."""
        self._refused[topic] += 1
        self._refusals.tell(f"{topic} refused: {reason}")


def _placed(obstacle: Obstacle, frame: pin.SE3) -> Obstacle:
    """Return an obstacle given in a frame as one given in the frame's parent."""
    position = frame.act(obstacle.position)
    orientation = pin.Quaternion(frame.rotation) * pin.Quaternion(obstacle.orientation)
    return Obstacle(obstacle.name, obstacle.shape, obstacle.size, position, orientation.coeffs())
