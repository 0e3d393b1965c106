# SPDX-License-Identifier: Apache-2.0
"""Messages into arrays and back: names matched, values and stamps checked."""

from __future__ import annotations

import math
from array import array
from collections import Counter
from collections.abc import Iterable, Sequence
from enum import Enum
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from geometry_msgs.msg import Point, PoseStamped, Vector3, WrenchStamped
from numpy.typing import NDArray
from sensor_msgs.msg import JointState

from viability_bounds_pkg.exceptions import did_you_mean
from viability_bounds_pkg.plausible import PlausibilityCheck
from viability_bounds_pkg.robot.gravity import Gravity
from viability_bounds_pkg.ros.refusals import Warn, count_refusal
from viability_bounds_pkg.ros.runtime import set_stamp, stamp_to_ns
from viability_bounds_pkg.state import State, whole_turns

Array = NDArray[np.float64]

_PERIODS_SEEN = 20
"""Fewer states do not tell their period."""


class JointOrder:
    """Where `joints` are in messages, which may name them in any order, and others with them.

    Attributes:
        index: of the joints in the names that were found last.
    """

    def __init__(self, joints: Sequence[str]) -> None:
        self._joints = tuple(joints)
        self._names: list[str] | None = None
        self.index: slice | NDArray[np.intp] = slice(None)

    def find(self, names: Sequence[str]) -> tuple[str, str]:
        """Set the index for a message's names.

        Returns:
            Why it cannot be set, and which joint it is: missing, or there twice; else empty.
        """
        if names == self._names:
            return "", ""
        where = {name: i for i, name in enumerate(names)}
        for joint in self._joints:
            if joint not in where:
                return "missing joint", f"there is no '{joint}'{did_you_mean(joint, names)}"
            if names.count(joint) > 1:
                return "joint twice", f"there is '{joint}' a second time"
        index = [where[joint] for joint in self._joints]
        self._names = list(names)
        self.index = slice(None) if index == list(range(len(names))) else np.array(index)
        return "", ""


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

    Only growing stamps are accepted, but also those of a source that has restarted: a robot or
    simulation that restarts counts time from the beginning again, and one corrupt stamp may lie
    far in the future.

    Args:
        joints: names of the n joints.
        reset_after: time without a later stamp after which any is accepted, s.
        warn: told in words when a message is dropped for a reason for the first time.
        check: of what is finite; None to accept it.
        needs_velocities: whether messages must have them; else, where they are missing or NaN,
            they are those at which the positions have changed since the last accepted message.
        continuous: whether a joint turns without end, shape (n,): its driver may report angles in
            any turn; None for no joint.
        gravity: what the motors give beyond the effort that is reported; None for nothing.

    Attributes:
        accepted: how many new states were accepted.
        message: the last accepted one; None before the first.
        q, v: its position and velocity, shape (n,), rad and rad/s.
        turns: whole turns by which continuous joints are in `q` beyond what the message has, so
            that they do not leap, shape (n,), rad.
        stamp: its stamp, ns.
        heard_at: when it came, or was repeated last, s.
        refused: how many messages were dropped, by reason.
    """

    def __init__(
        self,
        joints: Sequence[str],
        reset_after: float = 1.0,
        warn: Warn | None = None,
        check: PlausibilityCheck | None = None,
        needs_velocities: bool = True,
        continuous: NDArray[np.bool_] | None = None,
        gravity: Gravity | None = None,
    ) -> None:
        self._gravity = gravity
        self._order, self._reset_after = JointOrder(joints), reset_after
        self._warn, self._check, self._needs_velocities = warn, check, needs_velocities
        self._continuous = continuous if continuous is not None and continuous.any() else None
        self.accepted = 0
        self.message: JointState | None = None
        self.q, self.v, self.turns = np.zeros((3, len(joints)))
        self.stamp = -1
        self.heard_at = -math.inf
        self.refused: Counter[str] = Counter()
        self._newest, self._newest_at = -1, -math.inf  # stamp that came, ns, and when, s

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
        reason, detail = self._order.find(message.name)
        if reason:
            return self._refuse(reason, detail)
        velocity: Sequence[float] = message.velocity
        if not (self._needs_velocities or velocity):
            velocity = [math.nan] * len(message.name)
        if not len(message.position) == len(velocity) == len(message.name):
            sizes = (
                f"{len(message.name)} names, {len(message.position)} positions, "
                f"{len(message.velocity)} velocities"
            )
            return self._refuse("wrong size", sizes)
        index = self._order.index
        q, v = np.array(message.position)[index], np.array(velocity)[index]
        unknown = None
        # The sum is the quick test, NumPy's the exact one, of the joints that count.
        if not math.isfinite(sum(message.position) + sum(velocity)):
            unknown = np.isnan(v) & (not self._needs_velocities)
            if not (np.isfinite(q).all() and (np.isfinite(v) | unknown).all()):
                return self._refuse("not finite", "a position or velocity")
        turns = self.turns
        if self._continuous is not None and self.message is not None:
            q = q + turns
            if max(map(abs, (q - self.q).tolist())) > math.pi:  # seldom, and quick to see
                leap = whole_turns(q, self.q, self._continuous)
                q, turns = q + leap, turns + leap
        if unknown is not None and unknown.any():
            v = np.where(unknown, self._slope(q, stamp), v)
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
        self.q, self.v, self.stamp, self.message = q, v, stamp, message
        self.turns = turns
        self.heard_at = now
        self.accepted += 1
        return Arrival.NEW

    def effort(self) -> Array | None:
        """Return the torque of the motors in the last accepted message, shape (n,), N m.

        None where it does not tell, for each joint, a finite number.
        """
        message = self.message
        if message is None or len(message.effort) != len(message.name):
            return None
        self._order.find(message.name)
        tau = np.array(message.effort)[self._order.index]
        if self._gravity is not None:
            tau += self._gravity(self.q)
        return tau if all(map(math.isfinite, tau.tolist())) else None

    def with_state(self, state: State) -> JointState:
        """Return the last accepted message with another state of the joints, all else as it is.

        Continuous joints are in the turns of the message.
        """
        message = self.message
        if message is None:
            raise LookupError("no message was accepted yet")
        self._order.find(message.name)
        q = np.array(message.position)
        v = np.array(message.velocity) if message.velocity else np.zeros_like(q)
        q[self._order.index], v[self._order.index] = state.q - self.turns, state.v
        return JointState(
            header=message.header,
            name=message.name,
            position=array("d", q.tobytes()),
            velocity=array("d", v.tobytes()),
            effort=message.effort,
        )

    def _slope(self, q: Array, stamp: int) -> Array:
        """Return the velocity at which positions have changed since the last accepted message."""
        if stamp == self.stamp:
            return self.v
        known = 0 <= self.stamp < stamp
        return (q - self.q) / (1e-9 * (stamp - self.stamp)) if known else np.zeros_like(q)

    def _refuse(self, reason: str, detail: str = "") -> Arrival:
        count_refusal("joint_states", reason, detail, self.refused, self._warn)
        return Arrival.REFUSED


class PeriodCheck:
    """Compares the period of the states' stamps with that of a node's ``rate_hz``.

    Args:
        dt: control period of the node, s.
        warn: told once, in words, when they differ.
    """

    def __init__(self, dt: float, warn: Warn) -> None:
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


class TorqueCommand(NamedTuple):
    """Torques for the motors, shape (n,), N m."""

    tau: Array


class PositionCommand(NamedTuple):
    """Desired positions, rad, and velocities, rad/s, of the drives, shape (n,) each."""

    q: Array
    v: Array


JointCommand = TorqueCommand | PositionCommand


class CommandReader:
    """Reads ``joint_commands`` for `joints`.

    With efforts a message is a torque command, and its positions and velocities are ignored.
    Without efforts it is a position command; missing velocities are zero.

    Args:
        joints: names of the n joints.
        refused: counts invalid commands by reason.
        warn: told in words when one is dropped for a reason for the first time.
    """

    def __init__(self, joints: Sequence[str], refused: Counter[str], warn: Warn) -> None:
        self._order, self._refused, self._warn = JointOrder(joints), refused, warn

    def read(self, message: JointState) -> JointCommand | None:
        """Return the command in a message, None if it is invalid."""
        velocity = message.velocity or [0.0] * len(message.name)
        fields = [message.effort] if len(message.effort) else [message.position, velocity]
        if any(len(values) != len(message.name) for values in fields):
            reason, detail = "wrong size", ""
        else:
            reason, detail = self._order.find(message.name)
        if not reason:
            arrays = [np.array(values)[self._order.index] for values in fields]
            if all(math.isfinite(number) for each in arrays for number in each.tolist()):
                return TorqueCommand(*arrays) if len(message.effort) else PositionCommand(*arrays)
            reason = "not finite"
        count_refusal("joint_commands", reason, detail, self._refused, self._warn)
        return None


def numbers_of(*vectors: Point | Vector3) -> Array:
    """Return the numbers of one or more vectors, shape (3,) or (6,)."""
    return np.array([value for each in vectors for value in (each.x, each.y, each.z)])


def wrench_numbers(message: WrenchStamped) -> Array:
    """Return the numbers of a wrench, shape (6,), N and N m."""
    return numbers_of(message.wrench.force, message.wrench.torque)


def pose_message(pose: pin.SE3, frame: str = "", stamp: int = 0) -> PoseStamped:
    """Return a pose in the axes of a frame as a message, with a stamp in ns."""
    message = PoseStamped()
    message.header.frame_id = frame
    set_stamp(message.header.stamp, stamp)
    p, o = message.pose.position, message.pose.orientation
    p.x, p.y, p.z = pose.translation.tolist()
    o.x, o.y, o.z, o.w = pin.Quaternion(pose.rotation).coeffs().tolist()
    return message


def wrench_message(
    frame: str, force: Iterable[float], torque: Iterable[float] = (0.0, 0.0, 0.0), stamp: int = 0
) -> WrenchStamped:
    """Return a wrench as a message.

    Args:
        frame: its frame.
        force: three numbers, N.
        torque: three numbers, N m.
        stamp: ns.
    """
    message = WrenchStamped()
    message.header.frame_id = frame
    set_stamp(message.header.stamp, stamp)
    f, t = message.wrench.force, message.wrench.torque
    f.x, f.y, f.z = map(float, force)
    t.x, t.y, t.z = map(float, torque)
    return message
