# SPDX-License-Identifier: Apache-2.0
"""Nodes without an executor: callbacks run one after the other, on a clock that the test moves.

So what happens is the same each time, and as fast as the callbacks are. The nodes are the real
ones, with real publishers, subscriptions, timers and services; only who calls their callbacks, and
the module `time` that they see, are of the test. Messages are serialised, and made of the bytes
again, as the middleware does it, or go through the middleware itself.
"""

from __future__ import annotations

import sys
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

from fuzzing.message_edits import to_bytes
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message, serialize_message
from rclpy.subscription import Subscription

PACKAGES = ("viability_bounds_pkg", "torque_safety_controller", "sim_bridge")
_ARRIVAL = 1.0
"""How long a message may take through the middleware, s."""
_LOOK = 1e-8
_TICK = 1e-6
"""Time between two callbacks, s: no two are at the same time."""


class SteppedClock:
    """Stands for the module `time` in the modules of this project.

    Attributes:
        now: what `monotonic` returns, s.
    """

    def __init__(self) -> None:
        self.now = 1000.0

    def monotonic(self) -> float:
        """Return the time, s; each look takes some."""
        self.now += _LOOK
        return self.now

    def __getattr__(self, name: str) -> Any:
        return getattr(time, name)


@contextmanager
def stepped_clock() -> Iterator[SteppedClock]:
    """Let all modules of this project that have been imported see a clock of the test."""
    clock = SteppedClock()
    seen = [
        module
        for name, module in list(sys.modules.items())
        if name.split(".")[0] in PACKAGES
        and ".testing" not in name
        and getattr(module, "time", None) is time
    ]
    for module in seen:
        module.time = clock  # type: ignore[attr-defined]
    try:
        yield clock
    finally:
        for module in seen:
            module.time = time  # type: ignore[attr-defined]


class Delivery(NamedTuple):
    """A message that a callback is about to get, or got."""

    node: Node
    topic: str
    """Resolved name."""
    message: Any


class _Sent(NamedTuple):
    """A message on its way; `through` is a publisher, None for directly."""

    topic: str
    kind: type
    data: bytes
    through: Publisher | None


class Wire:
    """Takes messages from nodes to nodes; its methods are those that others want.

    Args:
        clock: of the nodes.

    Attributes:
        nodes: those that are there.
        filters: by resolved topic, what looks at messages that nodes publish, and returns whether
            they go on. Without one, they do.
        before, after: called before and after each callback of a subscription; what the first
            returns is given to the second.
    """

    def __init__(self, clock: SteppedClock) -> None:
        self.clock = clock
        self.nodes: list[Node] = []
        self.filters: dict[str, Callable[[Any], bool]] = {}
        self.before: Callable[[Delivery], Any] = lambda _: None
        self.after: Callable[[Delivery, Any], None] = lambda _, __: None
        self._queue: deque[_Sent] = deque()
        self._due: dict[Any, float] = {}

    # For `Topic` and `PublisherWatch`

    def publisher(self, node: Node, message: type, name: str, qos: QoSProfile) -> Publisher:
        """Return a publisher whose messages wait here."""
        publisher = node.create_publisher(message, name, qos, publisher_class=_Waiting)
        publisher.wire, publisher.resolved = self, publisher.topic_name
        return publisher

    def subscription(
        self,
        node: Node,
        message: type,
        name: str,
        qos: QoSProfile,
        receive: Callable[[Any], None],
    ) -> Subscription:
        """Return a subscription."""
        return node.create_subscription(message, name, receive, qos)

    def within(self, topic: str) -> bool:
        """Return that messages may come from elsewhere, too: rivals do."""
        return False

    def leave(self, node: Node) -> None:
        """Forget a node that is destroyed."""
        if node in self.nodes:
            self.nodes.remove(node)

    # Messages

    def note(self, topic: str, message: Any) -> None:
        """Take what a node publishes, as it is now."""
        kind, data = type(message), serialize_message(message)
        keep = self.filters.get(topic)
        if keep is None or keep(deserialize_message(data, kind)):
            self._queue.append(_Sent(topic, kind, data, None))

    def send(self, topic: str, message: Any, through: Publisher | None = None) -> None:
        """Deliver a message now, and all that follows from it.

        Args:
            topic: resolved name.
            message: may be odd.
            through: publisher to send it with, through the middleware; None for directly.
        """
        self._queue.append(_Sent(topic, type(message), to_bytes(message), through))
        self.settle()

    def settle(self) -> None:
        """Deliver what waits, and what follows from it, in order."""
        while self._queue:
            self._deliver(self._queue.popleft())

    def _deliver(self, sent: _Sent) -> None:
        heard = [
            (node, each)
            for node in list(self.nodes)
            for each in node.subscriptions
            if each.topic_name == sent.topic and each.msg_type is sent.kind
        ]
        if sent.through is not None:
            Publisher.publish(sent.through, sent.data)
        for node, subscription in heard:
            if sent.through is None:
                arrived = deserialize_message(sent.data, sent.kind)
            else:
                arrived = _taken(subscription)
            if arrived is not None:
                self._call(Delivery(node, sent.topic, arrived), subscription.callback)

    def _call(self, delivery: Delivery, callback: Callable[[Any], None]) -> None:
        self.clock.now += _TICK
        seen = self.before(delivery)
        callback(delivery.message)
        self.after(delivery, seen)

    # Time

    def pass_time(self, duration: float) -> None:
        """Let time pass, with the timers that are due."""
        end = self.clock.now + duration
        while (due := self._next_timer()) is not None and due[0] <= end:
            self.clock.now = max(self.clock.now, due[0])
            self._run(due[1])
        self.clock.now = max(self.clock.now, end)

    def stall(self, duration: float) -> None:
        """Let time pass in which nothing runs; timers that are due then run once."""
        self._next_timer()
        self.clock.now += duration
        for timer in [timer for timer, due in self._due.items() if due <= self.clock.now]:
            self._run(timer)

    def _next_timer(self) -> tuple[float, Any] | None:
        timers = [each for node in self.nodes for each in node.timers]
        for gone in self._due.keys() - set(timers):
            del self._due[gone]
        for timer in timers:
            if timer.is_canceled():
                self._due.pop(timer, None)
            elif timer not in self._due:
                self._due[timer] = self.clock.now + 1e-9 * timer.timer_period_ns
        if not self._due:
            return None
        first = min(self._due, key=self._due.__getitem__)
        return self._due[first], first

    def _run(self, timer: Any) -> None:
        self._due[timer] = self.clock.now + 1e-9 * timer.timer_period_ns
        timer.callback()
        self.settle()

    # Services

    def call(self, node: Node, service: str, request: Any) -> Any:
        """Call a service of a node, whose name ends with `service`; return the response."""
        (served,) = [each for each in node.services if each.srv_name.endswith(f"/{service}")]
        kind = served.srv_type
        request = deserialize_message(serialize_message(request), kind.Request)
        response = served.callback(request, kind.Response())
        self.settle()
        return deserialize_message(serialize_message(response), kind.Response)


class _Waiting(Publisher):
    """A publisher whose messages wait until they are delivered."""

    wire: Wire
    resolved: str

    def publish(self, msg: Any) -> None:
        self.wire.note(self.resolved, msg)


def _taken(subscription: Subscription) -> Any:
    """Return the message that has come through the middleware; None if it was lost."""
    deadline = time.monotonic() + _ARRIVAL
    while time.monotonic() < deadline:
        if found := subscription.handle.take_message(subscription.msg_type, subscription.raw):
            return found[0]
        time.sleep(0.0)
    return None
