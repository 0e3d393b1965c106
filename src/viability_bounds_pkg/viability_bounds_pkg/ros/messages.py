# SPDX-License-Identifier: Apache-2.0
"""Messages into arrays and back: names matched, values and stamps checked, refusals counted."""

from __future__ import annotations

import math
from array import array
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from enum import Enum
from typing import Any

import numpy as np
import pinocchio as pin
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseStamped
from numpy.typing import NDArray
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, MultiArrayDimension

from viability_bounds_pkg.exceptions import did_you_mean
from viability_bounds_pkg.plausible import PlausibilityCheck
from viability_bounds_pkg.ros.publisher_watch import PublisherWatch
from viability_bounds_pkg.ros.robot_urdf import DescriptionWatch
from viability_bounds_pkg.ros.runtime import set_stamp, stamp_to_ns
from viability_bounds_pkg.ros.topics import DIAGNOSTICS, VALUES
from viability_bounds_pkg.state import State

Report = Callable[[], tuple[bytes, str, dict[str, Any]]]
"""Returns level, message and values of a status."""


_PERIODS_SEEN = 20
"""Fewer states do not tell their period."""


class Arrival(Enum):
    """What a joint state is to its reader."""

    NEW = 1
    """Accepted: the arrays hold its values."""
    REPEATED = 2
    """The stamp and the values of the last accepted message: the robot repeats its state."""
    REFUSED = 3
    """Dropped and counted; the arrays hold what they held."""
    RESTARTED = 4
    """Accepted, of a robot that was silent or has restarted; only told by readers that answer."""
    RESUMED = 5
    """Repeated by a robot that was silent; only told by readers that answer."""


class JointStateReader:
    """Reads ``sensor_msgs/JointState`` into arrays in the order of `joints`.

    Names may come in any order, and joints of other limbs with them. Only growing stamps are
    accepted, but also those of a source that has restarted: a robot or simulation that restarts
    counts time from the beginning again, and one corrupt stamp may lie far in the future.

    Args:
        joints: names of the n joints.
        reset_after: time without a later stamp after which any is accepted, s.
        warn: told in words when a message is dropped for a reason for the first time.
        check: of what is finite; None to accept it.

    Attributes:
        accepted: how many new states were accepted.
        q, v: position and velocity of the last accepted message, shape (n,), rad and rad/s.
        stamp: its stamp, ns.
        heard_at: when it came, or was repeated last, s.
        refused: how many messages were dropped, by reason.
    """

    def __init__(
        self,
        joints: Sequence[str],
        reset_after: float = 1.0,
        warn: Callable[[str], object] | None = None,
        check: PlausibilityCheck | None = None,
    ) -> None:
        n = len(joints)
        self.accepted = 0
        self._warn, self._check = warn, check
        self.q = np.zeros(n)
        self.v = np.zeros(n)
        self.stamp = -1
        self.heard_at = -math.inf
        self.refused: Counter[str] = Counter()
        self._joints = tuple(joints)
        self._reset_after = reset_after
        self._newest, self._newest_at = -1, -math.inf  # stamp that came, ns, and when, s
        self._names: list[str] | None = None
        self._index: NDArray[np.intp] | None = None
        self._accepted: tuple[JointState, NDArray[np.intp] | None] | None = None

    def read(self, message: JointState, now: float) -> Arrival:
        """Read a message that arrived at `now`, in s on the steady clock."""
        stamp = stamp_to_ns(message.header.stamp)
        if stamp <= 0:
            # Later messages would have the same, and be taken for repeats of the first; below
            # zero there are no times, only stamps that stand for none.
            what = "zero" if stamp == 0 else "before zero"
            return self._refuse("no stamp", f"header.stamp is {what}")
        restarted = now - self._newest_at >= self._reset_after
        if stamp < self.stamp and not restarted:
            ago = 1e-9 * (self.stamp - stamp)
            return self._refuse("old stamp", f"{ago:.3g} s before that of the last one")
        if message.name != self._names and (missing := self._match(message.name)):
            hint = did_you_mean(missing, message.name)
            return self._refuse("missing joint", f"there is no '{missing}'{hint}")
        if not len(message.position) == len(message.velocity) == len(message.name):
            sizes = (
                f"{len(message.name)} names, {len(message.position)} positions, "
                f"{len(message.velocity)} velocities"
            )
            return self._refuse("wrong size", sizes)
        q, v = np.array(message.position), np.array(message.velocity)
        if self._index is not None:
            q, v = q[self._index], v[self._index]
        # The sum is the quick test, NumPy's the exact one, of the joints that count.
        if not math.isfinite(sum(message.position) + sum(message.velocity)) and not (
            np.isfinite(q).all() and np.isfinite(v).all()
        ):
            return self._refuse("not finite", "a position or velocity")
        if stamp == self.stamp:
            if np.array_equal(q, self.q) and np.array_equal(v, self.v):
                self.heard_at = now
                return Arrival.REPEATED
            if not restarted:
                return self._refuse("other values under the same stamp")
        if self._check is not None and restarted and stamp <= self._newest:
            self._check.reset()
        if restarted or stamp > self._newest:
            self._newest, self._newest_at = stamp, now
        if self._check is not None and (fault := self._check.fault(State(q, v), 1e-9 * stamp)):
            return self._refuse("impossible", fault)
        self.q, self.v, self.stamp = q, v, stamp
        self._accepted = message, self._index
        self.heard_at = now
        self.accepted += 1
        return Arrival.NEW

    @property
    def message(self) -> JointState | None:
        """The last accepted message; None before the first."""
        return None if self._accepted is None else self._accepted[0]

    def effort(self) -> NDArray[np.float64] | None:
        """Return the torque of the motors in the last accepted message, shape (n,), N m.

        None where it does not tell, for each joint, a finite number.
        """
        tau = np.empty_like(self.q)
        return tau if self.copy_effort(tau) and np.isfinite(tau).all() else None

    def copy_effort(self, tau: NDArray[np.float64]) -> bool:
        """Write that torque, finite or not, to `tau`, shape (n,), N m.

        Returns:
            Whether there is one.
        """
        if self._accepted is None:
            return False
        message, index = self._accepted
        if len(message.effort) != len(message.name):
            return False
        tau[:] = message.effort if index is None else np.array(message.effort)[index]
        return True

    def with_state(self, state: State) -> JointState:
        """Return the last accepted message with another state of the joints, all else as it is."""
        if self._accepted is None:
            raise LookupError("no message was accepted yet")
        message, index = self._accepted
        q, v = np.array(message.position), np.array(message.velocity)
        q[slice(None) if index is None else index] = state.q
        v[slice(None) if index is None else index] = state.v
        return JointState(
            header=message.header,
            name=message.name,
            position=array("d", q.tobytes()),
            velocity=array("d", v.tobytes()),
            effort=message.effort,
        )

    def _match(self, names: Sequence[str]) -> str:
        """Take the order of joints from `names`; return the first that is missing, or nothing."""
        where = {name: i for i, name in enumerate(names)}
        if missing := next((joint for joint in self._joints if joint not in where), ""):
            return missing
        self._names = list(names)
        index = [where[joint] for joint in self._joints]
        same_order = index == list(range(len(names)))
        self._index = None if same_order else np.array(index)
        return ""

    def _refuse(self, reason: str, detail: str = "") -> Arrival:
        self.refused[reason] += 1
        if self._warn is not None and self.refused[reason] == 1:
            self._warn(f"joint_states refused: {reason}" + (f": {detail}" if detail else ""))
        return Arrival.REFUSED


class PeriodCheck:
    """Compares the period of the states' stamps with that of a node's ``rate_hz``.

    Args:
        dt: control period of the node, s.
        warn: told once, in words, when they differ.
    """

    def __init__(self, dt: float, warn: Callable[[str], object]) -> None:
        self._dt, self._warn = dt, warn
        self._count, self._stamp, self._wrong = 0, -1, 0

    def compare(self, states: JointStateReader) -> None:
        """Compare the states since the last call; two calls must agree to warn."""
        count, span = states.accepted - self._count, 1e-9 * (states.stamp - self._stamp)
        known, self._count, self._stamp = self._stamp >= 0, states.accepted, states.stamp
        if not known or count < _PERIODS_SEEN or span <= 0.0 or self._wrong > 1:
            return
        period = span / count
        self._wrong = 0 if 0.8 < period / self._dt < 1.25 else self._wrong + 1
        if self._wrong > 1:
            self._warn(
                f"joint states come every {1e3 * period:.2g} ms by their stamps, but rate_hz "
                f"{1.0 / self._dt:g} means {1e3 * self._dt:.3g} ms: rates differ, or states are "
                "lost"
            )


DIAGNOSTICS_PERIOD = 0.5
"""Between two messages of a node, s; tests, which wait for them, shorten it."""


class Diagnostics:
    """Publishes one status on ``/diagnostics``, regularly and when asked.

    What is a number in it is also sent on ``~/values``, as a number, where that is subscribed to.

    Args:
        node: the publishing node; its name with the namespace, as in ``left/bounds_node``, is the
            status' name, so that two arms are told apart.
        report: returns level (a constant of ``DiagnosticStatus``), a message and the values.
        watch: its topics with several publishers, and a missing estimator, are reported, too, as a
            warning.
        description: that the robot's has changed is, too.
    """

    def __init__(
        self,
        node: Node,
        report: Report,
        watch: PublisherWatch | None = None,
        description: DescriptionWatch | None = None,
    ) -> None:
        self._watch = watch
        self._description = description
        self._report = report
        self._node = node
        self._publisher = DIAGNOSTICS.publisher(node)
        self._values_publisher = VALUES.publisher(node)
        # The steady clock, so that it is sent when /clock stops, too.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._timer = node.create_timer(DIAGNOSTICS_PERIOD, self.publish, clock=steady)

    def publish(self) -> None:
        """Send the status now."""
        level, message, values = self._report()
        if self._watch is not None:
            values["topics_with_several_publishers"] = self._watch.several or "none"
        troubles = [each.trouble for each in (self._watch, self._description) if each is not None]
        for trouble in filter(None, troubles):
            level = max(level, DiagnosticStatus.WARN)
            message += f"; {trouble}"
        status = DiagnosticStatus(
            level=level,
            name=self._node.get_fully_qualified_name().removeprefix("/"),
            message=message,
            hardware_id=self._node.get_namespace(),
            values=[KeyValue(key=key, value=_text(value)) for key, value in values.items()],
        )
        array = DiagnosticArray(status=[status])
        array.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(array)
        if self._values_publisher.get_subscription_count():
            self._values_publisher.publish(_numbers(values))


def _numbers(values: Mapping[str, Any]) -> Float64MultiArray:
    """Return the numbers and arrays among `values`, one after the other, labelled by key."""
    message = Float64MultiArray()
    for key, value in values.items():
        if isinstance(value, int | float | np.ndarray):
            numbers = np.atleast_1d(value)
            size = len(numbers)
            message.layout.dim.append(MultiArrayDimension(label=key, size=size, stride=size))
            message.data.extend(numbers.tolist())
    return message


def pose_message(pose: pin.SE3, frame: str = "", stamp: int = 0) -> PoseStamped:
    """Return a pose in the axes of a frame as a message, with a stamp in ns."""
    message = PoseStamped()
    message.header.frame_id = frame
    set_stamp(message.header.stamp, stamp)
    p, o = message.pose.position, message.pose.orientation
    p.x, p.y, p.z = pose.translation.tolist()
    o.x, o.y, o.z, o.w = pin.Quaternion(pose.rotation).coeffs().tolist()
    return message


def _text(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.9g}"
    if isinstance(value, np.ndarray):
        return " ".join(f"{item:.9g}" for item in value)
    if isinstance(value, Counter):
        return " ".join(f"{key}: {count};" for key, count in value.items()) or "none"
    return str(value)
