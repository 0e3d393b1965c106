# SPDX-License-Identifier: Apache-2.0
"""Messages of the control streams between nodes of one process, past the middleware."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any, cast

from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.serialization import serialize_message
from rclpy.subscription import Subscription

Receive = Callable[[Any], None]

_COPIES_PERIOD = 0.005
"""For how long copies are kept while turn follows turn, s; readers' buffers hold more."""


class DirectDelivery:
    """Gives messages of the control streams to the other nodes of a process, as the same objects.

    Where the process has the only publisher of a topic, its own subscriptions get the message from
    the executor's next turn, and leave unread what comes by the middleware. While a topic has a
    publisher elsewhere, all of its messages come by the middleware; then one subscription reads
    them for all nodes of the process.

    Each message is published as ever, where anybody outside of the process subscribes, but when
    the turn has ended, the newest first: who records or looks on does not delay the command, and
    to a robot elsewhere the command goes before copies of what led to it. While turn follows turn,
    as in lockstep, copies leave every few milliseconds: to wake another process takes far longer
    than to copy a message.

    One turn delivers what was sent meanwhile, too, in the order in which it was sent: from the
    state over the limits to the command. It ends where a topic comes a second time, so that in
    lockstep services, timers and goals are not kept waiting.

    As with the middleware, a message that was not delivered yet gives way to a newer one.
    Publishers may use a message again in the next turn, unless a subscriber keeps it.
    """

    def __init__(self) -> None:
        self._streams: dict[str, _Stream] = {}
        # The newest of each, in their order.
        self._sent: dict[_Stream, tuple[_DirectPublisher, Any]] = {}
        self._turn_due = False
        self._copies: list[tuple[_DirectPublisher, bytes]] = []
        self._published_at = -math.inf

    def publisher(self, node: Node, message: type, name: str, qos: QoSProfile) -> Publisher:
        """Return a publisher whose messages the nodes of this process get directly."""
        direct: _DirectPublisher
        # To count subscribers at each message takes longer than to deliver it.
        events = PublisherEventCallbacks(matched=lambda info: direct.note(info.current_count))
        publisher = node.create_publisher(
            message, name, qos, event_callbacks=events, publisher_class=_DirectPublisher
        )
        stream = self._stream(node, name)
        direct = cast(_DirectPublisher, publisher)
        direct.stream, direct.deliver = stream, lambda sent: self._send(node, direct, sent)
        stream.publishers += 1
        stream.settle()
        return publisher

    def subscription(
        self, node: Node, message: type, name: str, qos: QoSProfile, receive: Receive
    ) -> Subscription:
        """Return a subscription of a node of this process."""
        stream = self._stream(node, name)
        events = SubscriptionEventCallbacks()
        if not stream.subscriptions:
            events.matched = lambda info: stream.settle(info.current_count)
        subscription = node.create_subscription(
            message, name, stream.receive, qos, event_callbacks=events
        )
        stream.subscriptions.append((node, subscription, receive))
        stream.settle()
        return subscription

    def within(self, topic: str) -> bool:
        """Return whether messages of a topic can only be those of one publisher in this process.

        Args:
            topic: its name, resolved.
        """
        stream = self._streams.get(topic)
        return stream is not None and stream.direct and stream.publishers == 1

    def leave(self, node: Node) -> None:
        """Give a node back its subscriptions, so that they are destroyed with it."""
        for stream in self._streams.values():
            stream.give_back(node)
        gone = set(node.publishers)
        self._sent = {key: sent for key, sent in self._sent.items() if sent[0] not in gone}
        self._copies = [copy for copy in self._copies if copy[0] not in gone]

    def _stream(self, node: Node, name: str) -> _Stream:
        return self._streams.setdefault(node.resolve_topic_name(name), _Stream())

    def _send(self, node: Node, publisher: _DirectPublisher, message: Any) -> bool:
        """Have a message delivered in the next turn; return whether there will be one."""
        stream = publisher.stream
        if not stream.subscriptions or node.executor is None:
            return False  # nobody is there yet
        if earlier := self._sent.pop(stream, None):
            self._copy(*earlier)
        self._sent[stream] = publisher, message
        if not self._turn_due:
            self._turn_due = True
            node.executor.create_task(self._deliver, node)
        return True

    def _deliver(self, node: Node) -> None:
        delivered: dict[_Stream, tuple[_DirectPublisher, Any]] = {}
        while self._sent and (stream := next(iter(self._sent))) not in delivered:
            delivered[stream] = self._sent.pop(stream)
            stream.receive(delivered[stream][1])
        for sent in reversed(delivered.values()):
            self._copy(*sent)
        self._turn_due = bool(self._sent) and node.executor is not None
        if self._turn_due:
            node.executor.create_task(self._deliver, node)
        now = time.monotonic()
        if not self._turn_due or now - self._published_at > _COPIES_PERIOD:
            self._published_at = now
            for publisher, copy in self._copies:
                Publisher.publish(publisher, copy)
            self._copies.clear()

    def _copy(self, publisher: _DirectPublisher, message: Any) -> None:
        """Keep a copy for those outside, if there are any, as it is now."""
        # To make a copy that nobody reads takes longer than to deliver the message.
        if publisher.has_others:
            self._copies.append((publisher, serialize_message(message)))


class _DirectPublisher(Publisher):
    """A publisher to nodes of the same process and to others.

    Attributes:
        stream: its topic.
        deliver: gives a message to the nodes of the process; returns whether they will get it.
    """

    stream: _Stream
    deliver: Callable[[Any], bool]
    _subscribers = 0

    def publish(self, msg: Any) -> None:
        """Send a message."""
        if not (self.stream.direct and self.deliver(msg)):
            super().publish(msg)

    @property
    def has_others(self) -> bool:
        """Whether anybody outside of the process subscribes."""
        return self._subscribers > len(self.stream.subscriptions)

    def note(self, subscribers: int) -> None:
        """Take how many subscribe now, those of this process included."""
        self._subscribers = subscribers


class _Stream:
    """A topic in a process.

    Attributes:
        publishers: how many are in the process.
        subscriptions: of the process, with their nodes and callbacks; the first reads for all.
        direct: whether messages go past the middleware.
    """

    def __init__(self) -> None:
        self.publishers = 0
        self.subscriptions: list[tuple[Node, Subscription, Receive]] = []
        self.direct = False
        self._matched = 0

    def receive(self, message: Any) -> None:
        """Give a message to all nodes of the process that subscribe."""
        for _, _, receive in self.subscriptions:
            receive(message)

    def settle(self, matched: int | None = None) -> None:
        """Choose the way of the messages.

        Args:
            matched: how many publishers there are, those of this process included; None for as
                many as before.
        """
        self._matched = self._matched if matched is None else matched
        self.direct = 0 < self.publishers >= self._matched
        for index, (node, subscription, _) in enumerate(self.subscriptions):
            _read(node, subscription, not self.direct and index == 0)

    def give_back(self, node: Node) -> None:
        """Let the executor see the subscriptions of a node, which get nothing any more."""
        for each in [each for each in self.subscriptions if each[0] is node]:
            self.subscriptions.remove(each)
            _read(node, each[1], True)


def _read(node: Node, subscription: Subscription, wanted: bool) -> None:
    """Have the executor read a subscription, or leave what comes unread."""
    read_now = node._subscriptions  # rclpy has no other way to tell executors
    if wanted == (subscription in read_now):
        return
    if wanted:
        while subscription.handle.take_message(subscription.msg_type, subscription.raw):
            pass  # came directly, too
        read_now.append(subscription)
    else:
        read_now.remove(subscription)
    if node.executor is not None:
        node.executor.wake()
