# SPDX-License-Identifier: Apache-2.0
"""Valid messages of users for an arm: goals, wrenches, payloads, obstacles, at random."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from geometry_msgs.msg import (
    InertiaStamped,
    PoseStamped,
    Quaternion,
    Transform,
    Twist,
    TwistStamped,
    Vector3,
    WrenchStamped,
)
from numpy.typing import NDArray
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import (
    JointTrajectory,
    JointTrajectoryPoint,
    MultiDOFJointTrajectory,
    MultiDOFJointTrajectoryPoint,
)
from visualization_msgs.msg import Marker, MarkerArray

from viability_bounds_pkg.ros.runtime import set_stamp

_SHAPES = (Marker.CUBE, Marker.SPHERE, Marker.CYLINDER)


class GoodMessages:
    """Makes messages that an arm's nodes take.

    Args:
        values: parameters of the robot's file, by name.

    Attributes:
        kinds: what makes a message, by the name of its topic; called with random numbers and a
            stamp, ns, of which 0 means "now".
    """

    def __init__(self, values: Mapping[str, Any]) -> None:
        self._joints: list[str] = list(values["joints"])
        self._low = np.array(values["position_min"])
        self._high = np.array(values["position_max"])
        self._start = np.array(values["start_positions"])
        self._base: str = values["base_frame"]
        self._hand: str = values["end_effector_frame"]
        self._sensor: str = values.get("ft_frame") or self._hand
        self.kinds: dict[str, Callable[[np.random.Generator, int], Any]] = {
            "target_pose": self._pose,
            "target_posture": self._posture,
            "target_trajectory": self._trajectory,
            "target_joint_trajectory": self._joint_trajectory,
            "jog_hand": self._jog_hand,
            "jog_joints": self._jog_joints,
            "target_wrench": self._target_wrench,
            "external_wrench": self._push,
            "payload": self._payload,
            "obstacles": self._obstacles,
        }

    def posture(self, q: NDArray[np.float64], stamp: int = 0) -> JointState:
        """Return the goal of positions, shape (n,), rad."""
        message = JointState(name=self._joints, position=q.tolist())
        set_stamp(message.header.stamp, stamp)
        return message

    def _posture(self, rng: np.random.Generator, stamp: int) -> JointState:
        # Anywhere, or near where the arm begins.
        far = rng.uniform(self._low, self._high)
        near = np.clip(self._start + rng.uniform(-0.3, 0.3, len(far)), self._low, self._high)
        return self.posture(far if rng.random() < 0.5 else near, stamp)

    def _pose(self, rng: np.random.Generator, stamp: int) -> PoseStamped:
        message = PoseStamped()
        self._head(message.header, self._base, stamp)
        message.pose.orientation = _turn(rng)
        p = message.pose.position
        p.x, p.y, p.z = rng.uniform([-0.7, -0.7, 0.1], [0.7, 0.7, 0.9]).tolist()
        return message

    def _trajectory(self, rng: np.random.Generator, stamp: int) -> MultiDOFJointTrajectory:
        message = MultiDOFJointTrajectory(joint_names=[self._hand])
        self._head(message.header, self._base, stamp)
        place = rng.uniform([0.2, -0.4, 0.2], [0.6, 0.4, 0.8])
        turn = _turn(rng)
        for k in range(1 + int(rng.integers(6))):
            point = MultiDOFJointTrajectoryPoint(
                transforms=[Transform(translation=_vector(place), rotation=turn)],
                velocities=[Twist(linear=_vector(rng.uniform(-0.1, 0.1, 3)))],
                accelerations=[Twist(linear=_vector(rng.uniform(-0.1, 0.1, 3)))],
            )
            set_stamp(point.time_from_start, k * 200_000_000)
            message.points.append(point)
            place = place + rng.uniform(-0.03, 0.03, 3)
        return message

    def _joint_trajectory(self, rng: np.random.Generator, stamp: int) -> JointTrajectory:
        message = JointTrajectory(joint_names=self._joints)
        set_stamp(message.header.stamp, stamp)
        q, kind = self._start, rng.integers(3)
        for k in range(1, 1 + int(rng.integers(6))):  # none to five
            q = np.clip(q + rng.uniform(-0.2, 0.2, len(q)), self._low, self._high)
            point = JointTrajectoryPoint(positions=q.tolist())
            if kind > 0:
                point.velocities = rng.uniform(-0.3, 0.3, len(q)).tolist()
            if kind > 1:
                point.accelerations = rng.uniform(-1.0, 1.0, len(q)).tolist()
            set_stamp(point.time_from_start, k * 200_000_000)
            message.points.append(point)
        return message

    def _jog_hand(self, rng: np.random.Generator, stamp: int) -> TwistStamped:
        message = TwistStamped()
        self._head(message.header, str(rng.choice([self._base, self._hand, ""])), stamp)
        message.twist.linear = _vector(rng.uniform(-0.3, 0.3, 3))
        message.twist.angular = _vector(rng.uniform(-1.0, 1.0, 3))
        return message

    def _jog_joints(self, rng: np.random.Generator, stamp: int) -> JointState:
        names = [joint for joint in self._joints if rng.random() < 0.5] or self._joints
        message = JointState(name=names, velocity=rng.uniform(-1.0, 1.0, len(names)).tolist())
        set_stamp(message.header.stamp, stamp)
        return message

    def _target_wrench(self, rng: np.random.Generator, stamp: int) -> WrenchStamped:
        return self._wrench(rng, stamp, self._hand, 10.0)

    def _push(self, rng: np.random.Generator, stamp: int) -> WrenchStamped:
        return self._wrench(rng, stamp, self._sensor, 20.0)

    def _wrench(
        self, rng: np.random.Generator, stamp: int, frame: str, most: float
    ) -> WrenchStamped:
        message = WrenchStamped()
        self._head(message.header, frame, stamp)
        message.wrench.force = _vector(rng.uniform(-most, most, 3))
        message.wrench.torque = _vector(rng.uniform(-0.1 * most, 0.1 * most, 3))
        return message

    def _payload(self, rng: np.random.Generator, stamp: int) -> InertiaStamped:
        message = InertiaStamped()
        self._head(message.header, self._sensor, stamp)
        message.inertia.m = float(rng.uniform(0.0, 2.0))
        message.inertia.com = _vector(rng.uniform(-0.05, 0.05, 3))
        message.inertia.ixx = message.inertia.iyy = message.inertia.izz = 1e-3
        return message

    def _obstacles(self, rng: np.random.Generator, stamp: int) -> MarkerArray:
        message = MarkerArray()
        for _ in range(1 + int(rng.integers(3))):
            marker = Marker(ns=f"obstacle{rng.integers(4)}", type=int(rng.choice(_SHAPES)))
            self._head(marker.header, "", stamp)
            marker.action = Marker.DELETE if rng.random() < 0.2 else Marker.ADD
            p, s = marker.pose.position, marker.scale
            p.x, p.y, p.z = (rng.uniform(1.5, 3.0, 3)).tolist()
            s.x, s.y, s.z = rng.uniform(0.05, 0.3, 3).tolist()
            if marker.type == Marker.SPHERE:
                s.y = s.z = s.x
            if marker.type == Marker.CYLINDER:
                s.y = s.x
            marker.pose.orientation = _turn(rng)
            message.markers.append(marker)
        return message

    def _head(self, header: Any, frame: str, stamp: int) -> None:
        header.frame_id = frame
        set_stamp(header.stamp, stamp)


def _vector(values: NDArray[np.float64]) -> Vector3:
    x, y, z = values.tolist()
    return Vector3(x=x, y=y, z=z)


def _turn(rng: np.random.Generator) -> Quaternion:
    """Return an orientation at random."""
    values = rng.normal(size=4)
    x, y, z, w = (values / np.linalg.norm(values)).tolist()
    return Quaternion(x=x, y=y, z=z, w=w)
