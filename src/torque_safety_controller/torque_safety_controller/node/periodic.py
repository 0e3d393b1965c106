# SPDX-License-Identifier: Apache-2.0
"""What the controller node reads and answers each control period: states, limits, commands."""

from __future__ import annotations

import math
from array import array
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rclpy.exceptions import InvalidTopicNameException
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from torque_safety_controller.node.topics import ROS2_CONTROL_EFFORTS
from torque_safety_controller.qp import AccelerationRange
from viability_bounds_pkg.exceptions import SettingError
from viability_bounds_pkg.plausible import RESTART_GAP, PlausibilityCheck
from viability_bounds_pkg.robot.gravity import Gravity
from viability_bounds_pkg.ros.arm_node import ArmNode
from viability_bounds_pkg.ros.messages import Arrival, JointOrder, JointStateReader
from viability_bounds_pkg.ros.refusals import count_refusal
from viability_bounds_pkg.ros.runtime import stamp_to_ns
from viability_bounds_pkg.ros.topics import COMMANDED_ACCELERATIONS, JOINT_COMMANDS

UNSEEN = 3
"""Refused states in a row after which nothing is known of the arm."""

ELSEWHERE = 0.05
"""By how much positions differ where an arm has been moved while its stamps leapt, rad."""


class StateStream(JointStateReader):
    """Joint states as they come and are answered, in the order of `joints`.

    Args:
        joints: names of the n joints.
        timeout: how long without a usable state until the arm counts as silent, s.
        warn: told in words when a state is dropped for a reason for the first time.
        check: of what is finite; None to accept it.
        continuous, gravity: see `JointStateReader`.

    Attributes:
        message_at: when the last message came, usable or not, s on the steady clock.
        message_stamp: its stamp, as in messages.
        usable_at: when the last usable one came, s.
        waiting_since: since when there is a state to answer, s.
        answered_stamp: of the state answered last, ns; -1 if there is none since it began.
        refused_in_row: states dropped since the last usable one, of an arm that is answered.
        missed: whether states of the arm that was answered were missing before the last one.
        unseen: whether the arm may have been put elsewhere before the last one: stamps have leapt
            as after a start of the robot, or `UNSEEN` states were dropped.
    """

    def __init__(
        self,
        joints: Sequence[str],
        timeout: float,
        warn: Callable[[str], object] | None = None,
        check: PlausibilityCheck | None = None,
        continuous: NDArray[np.bool_] | None = None,
        gravity: Gravity | None = None,
    ) -> None:
        super().__init__(joints, timeout, warn, check, continuous=continuous, gravity=gravity)
        self._timeout = timeout
        self.message_at = self.usable_at = self.waiting_since = -math.inf
        self.message_stamp: Any = None
        self.answered_stamp = -1
        self.refused_in_row = 0
        self.missed = self.unseen = False

    def read(self, message: JointState, now: float) -> Arrival:
        """Read a message that arrived at `now`, in s on the steady clock."""
        self.message_at, self.message_stamp = now, message.header.stamp
        last, was_at = self.stamp, self.q
        arrival = super().read(message, now)
        if arrival is Arrival.REFUSED:
            return arrival
        dropped, self.refused_in_row = self.refused_in_row, 0
        silent = self.silent(now)
        self.usable_at = now
        self.missed = silent and 0 <= self.answered_stamp <= last < self.stamp
        if arrival is Arrival.REPEATED:
            return Arrival.RESUMED if silent else arrival
        if last >= 0:  # where its time stood still, as of a halted simulation, the arm did, too
            silent = silent and self.stamp - last > 1e9 * self._timeout
        # Where the time alone has leapt, the arm goes on without a jolt.
        leapt = self.stamp - last >= 1e9 * RESTART_GAP
        self.unseen = leapt or dropped >= UNSEEN
        elsewhere = leapt and bool((np.abs(self.q - was_at) > ELSEWHERE).any())
        if silent or self.stamp <= last or elsewhere:
            return Arrival.RESTARTED
        if self.answered_stamp == last:
            self.waiting_since = now
        return Arrival.NEW

    def mark_answered(self) -> None:
        """Count the last state as answered."""
        self.answered_stamp = self.stamp

    def forget_answers(self) -> None:
        """Start at the last usable state: nothing before it was answered."""
        self.answered_stamp = -1
        self.waiting_since = self.usable_at

    def silent(self, now: float) -> bool:
        """Return whether no usable state has come for longer than the time-out."""
        return now - self.usable_at > self._timeout

    def waits(self, now: float) -> float:
        """Return for how long the last state has waited for its answer, s; 0 if it does not."""
        if self.stamp == self.answered_stamp or self.refused_in_row:
            return 0.0
        return now - self.waiting_since

    def elapsed(self) -> float | None:
        """Return the time since the state answered last, s; None if there is none."""
        if self.answered_stamp < 0:
            return None
        return 1e-9 * (self.stamp - self.answered_stamp)

    @property
    def why_refused(self) -> str:
        """Why states were dropped since the start, in words; empty if the last was usable."""
        if self.message_at <= self.usable_at:
            return ""
        return "joint states are refused: " + ", ".join(self.refused)


class LimitsReader:
    """Reads ``acceleration_limits`` into arrays in the order of `joints`.

    Args:
        joints: names of the n joints.
        warn: told in words when a message is dropped for a reason for the first time.

    Attributes:
        range: of the last accepted message, shape (n,) each, rad/s^2.
        stamp: of the state that they belong to, ns.
        refused: how many messages were dropped, by reason.
    """

    def __init__(self, joints: Sequence[str], warn: Callable[[str], object] | None = None) -> None:
        self._warn = warn
        self.range = AccelerationRange(np.zeros(len(joints)), np.zeros(len(joints)))
        self.stamp = -1
        self.refused: Counter[str] = Counter()
        self._order = JointOrder(joints)

    def read(self, message: JointTrajectory) -> bool:
        """Take a message; return whether it was accepted."""
        if len(message.points) != 2:
            return self._refuse("wrong number of points")
        first, second = message.points
        lower, upper = np.array(first.accelerations), np.array(second.accelerations)
        if not len(lower) == len(upper) == len(message.joint_names):
            return self._refuse("wrong size")
        reason, detail = self._order.find(message.joint_names)
        if reason:
            return self._refuse(reason, detail)
        limits = AccelerationRange(lower[self._order.index], upper[self._order.index])
        if fault := limits.fault:
            return self._refuse(fault)
        self.range = limits
        self.stamp = stamp_to_ns(message.header.stamp)
        return True

    def check_clock(self, stamp: int) -> None:
        """Refuse the last message where it cannot be meant for a state with a stamp, ns."""
        if self.stamp >= 0 and abs(self.stamp - stamp) > 1e9 * RESTART_GAP:
            detail = f"header.stamp is {1e-9 * self.stamp:.13g} s instead of {1e-9 * stamp:.13g} s"
            self._refuse("not the stamp of the joint state", detail)

    def _refuse(self, reason: str, detail: str = "") -> bool:
        count_refusal("acceleration_limits", reason, detail, self.refused, self._warn)
        return False


class JointCommands:
    """Publishes ``joint_commands``, and torques for ros2_control where that is asked for.

    Args:
        node: the publishing node.
        joints: names of the n joints.
        ros2_control_topic: of the torques in `joints` order; empty for none.
        accelerations: whether ``commanded_accelerations`` go with them.

    Raises:
        SettingError: it is no name of a topic.
    """

    def __init__(
        self,
        node: ArmNode,
        joints: Sequence[str],
        ros2_control_topic: str,
        accelerations: bool = False,
    ) -> None:
        self._torques = JointState(name=list(joints))
        self._positions = JointState(
            name=list(joints), velocity=array("d", np.zeros(len(joints)).tobytes())
        )
        self._last = self._torques
        self._commands = node.stream(JOINT_COMMANDS)
        self._accelerations = None
        if accelerations:
            self._accelerations = node.stream(COMMANDED_ACCELERATIONS)
        self._efforts = None
        if ros2_control_topic:
            try:
                self._efforts = ROS2_CONTROL_EFFORTS.publisher(node, ros2_control_topic)
            except InvalidTopicNameException as error:
                allowed = "the name of a topic"
                raise SettingError("ros2_control_topic", ros2_control_topic, allowed) from error
            node.publisher_watch.add(self._efforts.topic_name)

    def accelerations(self, a: np.ndarray, stamp: Any) -> None:
        """Tell, where it is asked for, what the next command stands for, shape (n,), rad/s^2."""
        if self._accelerations is None:
            return
        point = JointTrajectoryPoint(accelerations=array("d", a.tobytes()))
        message = JointTrajectory(joint_names=self._torques.name, points=[point])
        message.header.stamp = stamp
        self._accelerations.publish(message)

    def torque(self, tau: np.ndarray, stamp: Any) -> None:
        """Send torques, shape (n,), N m, for the state with `stamp`."""
        self._torques.effort = array("d", tau.tobytes())
        self._last = self._torques
        self.again(stamp)

    def position(self, q: np.ndarray, stamp: Any) -> None:
        """Have the drives hold positions, shape (n,), rad, from the state with `stamp` on."""
        self._positions.position = array("d", q.tobytes())
        self._last = self._positions
        self.again(stamp)

    def again(self, stamp: Any) -> None:
        """Send the last command again, torques or positions, because a state was repeated."""
        self._last.header.stamp = stamp
        self._commands.publish(self._last)
        if self._efforts is not None and self._last is self._torques:
            self._efforts.publish(Float64MultiArray(data=self._torques.effort))
