"""What befalls a simulated robot: pushes and obstacles from messages, at the time they name."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import pinocchio as pin
from geometry_msgs.msg import WrenchStamped
from rclpy.node import Node
from visualization_msgs.msg import Marker, MarkerArray

from sim_bridge.bullet.obstacles import Obstacle, ObstacleError
from sim_bridge.bullet.robot import BulletRobot
from sim_bridge.nodes.topics import EXTERNAL_WRENCH, OBSTACLES
from viability_bounds_pkg.robot_description import RobotDescriptionError
from viability_bounds_pkg.ros.runtime import stamp_to_ns

_NO_PUSH = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
_SHAPES = {Marker.CUBE: "box", Marker.SPHERE: "sphere", Marker.CYLINDER: "cylinder"}
_REASONS = (RobotDescriptionError, ObstacleError, ValueError)


class _Change(NamedTuple):
    """Something that is to happen to the world."""

    stamp: int
    topic: str
    link: str
    """That is pushed, or the empty string."""
    apply: Callable[[], object]


class WorldInbox:
    """Takes ``external_wrench`` and ``obstacles`` for a robot.

    A stamp of zero, or one that has passed, takes effect with the next control period; one
    ahead with the first period that begins then or after.

    Args:
        node: listens and logs what is refused.
        robot: what it happens to.
        push_timeout: how long a push lasts unless another message for its link has come or is
            waiting for its time, s of robot time.
        refused: counts the messages that were refused, by topic.

    Attributes:
        pushed: until when each link is pushed unless a message says otherwise, ns.
    """

    def __init__(
        self, node: Node, robot: BulletRobot, push_timeout: float, refused: Counter[str]
    ) -> None:
        self._logger = node.get_logger()
        self._robot, self._refused = robot, refused
        self._push_timeout = round(1e9 * push_timeout)
        self._pending: list[_Change] = []
        self.pushed: dict[str, int] = {}
        EXTERNAL_WRENCH.subscription(node, self._on_wrench)
        OBSTACLES.subscription(node, self._on_obstacles)

    def __len__(self) -> int:
        """How many messages wait for their time."""
        return len(self._pending)

    def clear(self) -> None:
        """Take all pushes and obstacles away, and forget what was to come."""
        self._pending.clear()
        self.pushed.clear()
        self._robot.clear_wrenches()
        self._robot.clear_obstacles()

    def apply_due(self, stamp: int) -> None:
        """Do what is due in the control period that begins at `stamp`, ns."""
        while self._pending and self._pending[0].stamp <= stamp:
            change = self._pending.pop(0)
            try:
                change.apply()
            except _REASONS as error:
                self._refuse(change.topic, error)
            if change.link:
                self.pushed[change.link] = stamp + self._push_timeout
        if not self.pushed:
            return
        planned = {change.link for change in self._pending}
        for link, until in list(self.pushed.items()):
            if stamp >= until and link not in planned:
                self._robot.apply_wrench(link, *_NO_PUSH)
                del self.pushed[link]
        if not self.pushed:
            self._robot.clear_wrenches()

    def _add(self, change: _Change) -> None:
        self._pending.append(change)
        self._pending.sort(key=lambda pending: pending.stamp)

    def _on_wrench(self, message: WrenchStamped) -> None:
        link = message.header.frame_id
        f, t = message.wrench.force, message.wrench.torque
        force, torque = (f.x, f.y, f.z), (t.x, t.y, t.z)
        try:
            self._robot.link_pose(link)
            if not all(map(math.isfinite, force + torque)):
                raise ValueError("it is not finite")
        except _REASONS as error:
            return self._refuse("external_wrench", error)
        stamp = stamp_to_ns(message.header.stamp)
        push = partial(self._robot.apply_wrench, link, force, torque)
        self._add(_Change(stamp, "external_wrench", link, push))

    def _on_obstacles(self, message: MarkerArray) -> None:
        for marker in message.markers:
            try:
                apply = self._obstacle_change(marker)
            except _REASONS as error:
                self._refuse("obstacles", error)
                continue
            self._add(_Change(stamp_to_ns(marker.header.stamp), "obstacles", "", apply))

    def _obstacle_change(self, marker: Marker) -> Callable[[], object]:
        """Return what a marker asks for.

        Raises:
            ObstacleError: an action or a shape that there is not, or numbers that cannot be.
            RobotDescriptionError: a frame that the robot does not have.
        """
        robot, name = self._robot, marker.ns
        if marker.action == Marker.DELETEALL:
            return robot.clear_obstacles
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
            return partial(robot.add_obstacle, given)
        robot.link_pose(frame)  # or it raises
        return lambda: robot.add_obstacle(_placed(given, robot.link_pose(frame)))

    def _remove(self, name: str) -> None:
        if not self._robot.remove_obstacle(name):
            raise ObstacleError(f"there is no obstacle {name!r}")

    def _refuse(self, topic: str, error: Exception) -> None:
        self._refused[topic] += 1
        self._logger.warning(f"{topic} refused: {error}")


def _placed(obstacle: Obstacle, frame: pin.SE3) -> Obstacle:
    """Return an obstacle given in a frame as one given in the frame's parent."""
    position = frame.act(obstacle.position)
    orientation = pin.Quaternion(frame.rotation) * pin.Quaternion(obstacle.orientation)
    return Obstacle(obstacle.name, obstacle.shape, obstacle.size, position, orientation.coeffs())
