# SPDX-License-Identifier: Apache-2.0
"""The fault node: spoils the messages between the other nodes, as a file says, for tests."""

from __future__ import annotations

import heapq
import itertools
import sys
import time
from collections import Counter
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.publisher import Publisher

from sim_bridge.faults.fault import Passage
from sim_bridge.faults.faulty_stream import FaultyStream
from sim_bridge.faults.message_values import joints_of, stamp_of
from sim_bridge.faults.timeline import Timeline, TimelineError, load_timeline
from viability_bounds_pkg.exceptions import SettingError
from viability_bounds_pkg.parameter import Range, text, whole_number
from viability_bounds_pkg.ros.arm_node import ArmNode
from viability_bounds_pkg.ros.messages import Diagnostics
from viability_bounds_pkg.ros.parameters import NodeParameters
from viability_bounds_pkg.ros.program import run
from viability_bounds_pkg.ros.topics import (
    ACCELERATION_LIMITS,
    ESTIMATED_JOINT_STATES,
    FT_WRENCH,
    JOINT_COMMANDS,
    JOINT_STATES,
    Topic,
)

STREAMS = {
    topic.name: topic
    for topic in (
        JOINT_STATES,
        ESTIMATED_JOINT_STATES,
        ACCELERATION_LIMITS,
        JOINT_COMMANDS,
        FT_WRENCH,
    )
}
"""Topics that may pass."""
BEFORE = "before_faults/"
"""Comes before the name of a topic whose messages have not passed yet."""
_TICK = 5e-4
"""How exactly delays are kept, s."""


@dataclass(frozen=True, eq=False, kw_only=True)
class FaultConfiguration:
    """Parameters of the fault node.

    Attributes:
        timeline: what passes, and the faults.
    """

    faults: str = text("YAML file of the faults")
    fault_seed: int = whole_number("of the random numbers", Range(0, 2**31 - 1), default=0)
    timeline: Timeline = field(init=False)

    def __post_init__(self) -> None:
        """Read the file."""
        try:
            timeline = load_timeline(self.faults, tuple(STREAMS))
        except TimelineError as error:
            reason = str(error).removeprefix(f"faults {self.faults}").lstrip(":, ")
            raise SettingError("faults", self.faults, f"a file of faults ({reason})") from error
        object.__setattr__(self, "timeline", timeline)


class FaultNode(ArmNode):
    """Passes messages on from ``before_faults/<topic>`` to ``<topic>``, with faults over time.

    Attributes:
        streams: by the name of the topic.
    """

    NAME = "fault_node"
    PARAMETERS = FaultConfiguration

    def __init__(self, **node_arguments: Any) -> None:
        super().__init__(**node_arguments)
        self._rivals: dict[str, Node] = {}
        topics: list[Topic] = []
        with self.starting():
            config = NodeParameters(self, FaultConfiguration).configuration
            topics = [STREAMS[name] for name in config.timeline.faults]
            for topic in topics:
                self.claim("publishes", self.resolve_topic_name(topic.name))
        self._faults = config.timeline.faults
        self.streams = {
            name: FaultyStream(faults, config.fault_seed + k)
            for k, (name, faults) in enumerate(self._faults.items())
        }
        # Not the stamps of answers, which spoilt stamps come back in.
        self._reference = topics[0].name
        self._outputs = {topic.name: topic.publisher(self) for topic in topics}
        self._rival_outputs: dict[str, Publisher] = {}
        self._acting: list[str] = []
        self._passed: Counter[str] = Counter()
        self._strange: set[str] = set()
        self._begin = -1
        self._time = 0.0
        # When to send on, a number that keeps the order of equal times, topic and passage.
        self._later: list[tuple[float, int, str, Passage]] = []
        self._numbers = itertools.count()
        for topic in topics:
            receive = partial(self._on_message, topic.name)
            self.create_subscription(topic.message, BEFORE + topic.name, receive, topic.qos)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._timer = self.create_timer(_TICK, self._send_due, clock=steady)
        self._timer.cancel()
        self._diagnostics = Diagnostics(self, self._report)
        published, heard = map(" ".join, self.topics_used())
        count = sum(map(len, self._faults.values()))
        self.get_logger().info(f"{count} faults; subscribes to {heard}; publishes {published}")

    def destroy_node(self) -> None:
        """End the rivals, too."""
        for node in self._rivals.values():
            node.destroy_node()
        self._rivals = {}
        super().destroy_node()

    def _on_message(self, name: str, message: Any) -> None:
        if name == self._reference:
            stamp = stamp_of(message)
            if not 0 <= self._begin <= stamp:
                self._begin = stamp  # the first, or the robot restarted
            self._time = 1e-9 * (stamp - self._begin)
        for each, stream in self.streams.items():
            self._send(each, stream.at(self._time))
        self._tell()
        self._check_joints(name, message)
        self._passed[name] += 1
        self._send(name, self.streams[name].passages(message))

    def _send(self, name: str, passages: list[Passage]) -> None:
        for each in passages:
            if each.delay > 0.0:
                due = time.monotonic() + each.delay
                heapq.heappush(self._later, (due, next(self._numbers), name, each))
                self._timer.reset()
            else:
                self._publish(name, each)

    def _send_due(self) -> None:
        now = time.monotonic()
        while self._later and self._later[0][0] <= now:
            _, _, name, passage = heapq.heappop(self._later)
            self._publish(name, passage)
        if not self._later:
            self._timer.cancel()

    def _publish(self, name: str, passage: Passage) -> None:
        publisher = self._rival(name) if passage.rival else self._outputs[name]
        publisher.publish(passage.message)

    def _rival(self, name: str) -> Publisher:
        """Return the publisher of another node."""
        if name not in self._rivals:
            node = Node(
                f"rival_of_{name}",
                context=self.context,
                namespace=self.get_namespace(),
                use_global_arguments=False,  # a name given to this node is not for the other
                start_parameter_services=False,
            )
            topic = STREAMS[name]
            self._rivals[name] = node
            self._rival_outputs[name] = node.create_publisher(
                topic.message, self.resolve_topic_name(name), topic.qos
            )
        return self._rival_outputs[name]

    def _tell(self) -> None:
        """Log which faults begin and end, and let rivals go whose time is over."""
        acting = [f"{kind} {name}" for name, each in self.streams.items() for kind in each.acting]
        if acting == self._acting:
            return
        self._acting = acting
        for name in [each for each in self._rivals if f"rival {each}" not in acting]:
            self._rivals.pop(name).destroy_node()
        what = ", ".join(acting) or "none"
        self.get_logger().info(f"{self._time:.3f} s, faults: {what}")

    def _check_joints(self, name: str, message: Any) -> None:
        """Warn once of joints in the file that messages do not have."""
        if name in self._strange:
            return
        self._strange.add(name)
        wanted = {joint for fault in self._faults[name] for joint in getattr(fault, "joints", ())}
        if others := sorted(wanted - set(joints_of(message))):
            self.get_logger().warning(
                f"'{name}' has no {', '.join(others)}: faults of these joints change nothing"
            )

    def _report(self) -> tuple[bytes, str, dict[str, Any]]:
        values: dict[str, Any] = {
            "time_s": self._time,
            "passed": self._passed,
            "waiting": len(self._later),
        }
        for name, stream in self.streams.items():
            values[f"touched_{name}"] = stream.touched
        if self._acting:
            return DiagnosticStatus.WARN, f"faults: {', '.join(self._acting)}", values
        return DiagnosticStatus.OK, "messages pass unchanged", values


def main(args: list[str] | None = None) -> int:
    """Run the fault node until it is told to stop."""
    return run(FaultNode, args)


if __name__ == "__main__":
    sys.exit(main())
