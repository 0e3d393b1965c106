# SPDX-License-Identifier: Apache-2.0
"""Streams: states, limits and commands, to listeners in the same process and to ROS."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.event_handler import PublisherEventCallbacks
from rclpy.node import Node
from rclpy.qos import QoSProfile

from viability_bounds_pkg.ros.publisher_watch import PublisherWatch
from viability_bounds_pkg.ros.topics import Topic

Listener = Callable[[Any], None]


class Stream:
    """Messages of one topic that a node publishes.

    Args:
        node: publishes them.
        topic: of the messages.

    Attributes:
        listeners: callbacks of this process that get each message as the same object.
        subscribers: how many subscribe in ROS.
        queue: takes messages to the listeners; None while there are none.
        topic_name: of the topic, resolved.
    """

    def __init__(self, node: Node, topic: Topic) -> None:
        # To count at each message takes longer than to deliver it.
        events = PublisherEventCallbacks(matched=self._on_matched)
        self.subscribers = 0
        self._publisher = node.create_publisher(
            topic.message, topic.name, topic.offered, event_callbacks=events
        )
        self.topic_name: str = self._publisher.topic_name
        self.listeners: list[Listener] = []
        self.queue: Queue | None = None

    def _on_matched(self, info: Any) -> None:
        self.subscribers = info.current_count

    def publish(self, message: Any) -> None:
        """Send a message; it may be used again when the listeners have got it."""
        if self.queue is not None and self.listeners:
            self.queue.add(self, message)
        else:
            self._publisher.publish(message)

    def in_turn(self, act: Callable[[], None]) -> None:
        """Do in a callback of the executor what may publish; see `Queue.in_turn`."""
        if self.queue is None:
            act()
        else:
            self.queue.in_turn(act)

    def publish_outside(self, message: Any) -> None:
        """Send a message to other processes, if any of them subscribes."""
        if self.subscribers:
            self._publisher.publish(message)


class Input:
    """Messages of one topic that a node obeys: of one publisher only.

    Args:
        node: subscribes.
        topic: of the messages.
        callback: gets them.
        watch: tells whether there is one publisher.
        qos: of the subscription; None for that of the topic.
        of_other: whether a message is of something else, whose publisher does not count.

    Attributes:
        listeners: the callback, and those of other nodes of the process that share the
            subscription.
        queue: takes what they publish to listeners in the process; None while there are none.
        topic_name: of the topic, resolved.
    """

    def __init__(
        self,
        node: Node,
        topic: Topic,
        callback: Listener,
        watch: PublisherWatch,
        qos: QoSProfile | None = None,
        of_other: Callable[[Any], bool] = lambda _: False,
    ) -> None:
        self.listeners = [callback]
        self.queue: Queue | None = None
        self._node, self._watch, self._of_other = node, watch, of_other
        self._subscription = node.create_subscription(
            topic.message, topic.name, self._receive, qos or topic.qos
        )
        self.topic_name: str = self._subscription.topic_name

    def _receive(self, message: Any) -> None:
        if not self._watch.admits(self.topic_name, self._of_other(message)):
            return
        if self.queue is None:
            self._hand_on(message)
        else:
            self.queue.in_turn(lambda: self._hand_on(message))

    def _hand_on(self, message: Any) -> None:
        for listener in self.listeners:
            listener(message)

    def unsubscribe(self) -> None:
        """Get no messages from ROS any more."""
        self._node.destroy_subscription(self._subscription)


class Queue:
    """The newest message of each stream on its way to the listeners in the process.

    One turn of the executor also delivers what listeners publish: from the state over the limits
    to the command. It ends where a stream comes a second time, so that in lockstep services,
    timers and goals have their turn. Other processes get the messages when the turn has ended,
    the newest first, so that a recorder does not delay the command.

    Args:
        node: whose executor makes the turns.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._messages: dict[Stream, Any] = {}
        self._scheduled = False

    def add(self, stream: Stream, message: Any) -> None:
        """Deliver a message in the next turn, instead of an older one of the stream."""
        self._messages.pop(stream, None)
        self._messages[stream] = message
        self._schedule()

    def in_turn(self, act: Callable[[], None]) -> None:
        """Do in a callback of the executor what may publish, and deliver it in the same turn."""
        if self._scheduled:  # it is delivered with what waits
            act()
            return
        self._scheduled = True
        act()
        self._deliver()

    def _schedule(self) -> None:
        if self._scheduled or not self._messages:
            return
        if (executor := self._node.executor) is not None:
            self._scheduled = True
            executor.create_task(self._deliver)

    def _deliver(self) -> None:
        delivered: dict[Stream, Any] = {}
        while self._messages and (stream := next(iter(self._messages))) not in delivered:
            message = delivered[stream] = self._messages.pop(stream)
            for listener in stream.listeners:
                listener(message)
        for stream, message in reversed(delivered.items()):
            stream.publish_outside(message)
        self._scheduled = False
        self._schedule()
