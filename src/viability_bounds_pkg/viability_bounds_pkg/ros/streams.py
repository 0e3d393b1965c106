# SPDX-License-Identifier: Apache-2.0
"""Streams: states, limits and commands, to listeners in the same process and to ROS."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from rclpy.event_handler import PublisherEventCallbacks
from rclpy.node import Node
from rclpy.qos import QoSProfile

from viability_bounds_pkg.ros.publisher_watch import PublisherWatch
from viability_bounds_pkg.ros.topics import (
    ESTIMATED_JOINT_STATES,
    JOINT_STATES,
    Topic,
    state_topic,
)

Listener = Callable[[Any], None]


class Stream:
    """Messages of one topic that a node publishes.

    Args:
        node: publishes them.
        message: their type.
        name: of the topic.
        qos: of the publisher.

    Attributes:
        listeners: callbacks of this process that get each message as the same object.
        subscribers: how many subscribe in ROS.
        queue: takes messages to the listeners; None while there are none.
    """

    def __init__(self, node: Node, message: type, name: str, qos: QoSProfile) -> None:
        # To count at each message takes longer than to deliver it.
        events = PublisherEventCallbacks(matched=self._on_matched)
        self._publisher = node.create_publisher(message, name, qos, event_callbacks=events)
        self.subscribers = 0
        self.listeners: list[Listener] = []
        self.queue: Queue | None = None

    def _on_matched(self, info: Any) -> None:
        self.subscribers = info.current_count

    @property
    def topic_name(self) -> str:
        """Name of the topic, resolved."""
        return self._publisher.topic_name

    def publish(self, message: Any) -> None:
        """Send a message; it may be used again when the listeners have got it."""
        if self.queue is not None and self.listeners:
            self.queue.add(self, message)
        else:
            self._publisher.publish(message)

    def publish_outside(self, message: Any) -> None:
        """Send a message to other processes, if any of them subscribes."""
        if self.subscribers:
            self._publisher.publish(message)


class Input:
    """Messages of one topic that a node obeys: of one publisher only.

    Args:
        node: subscribes.
        message: their type.
        name: of the topic.
        qos: of the subscription.
        callback: gets the messages.
        watch: tells whether there is one publisher.

    Attributes:
        listeners: the callback, and those of other nodes of the process that share the
            subscription.
        topic_name: of the topic, resolved.
    """

    def __init__(
        self,
        node: Node,
        message: type,
        name: str,
        qos: QoSProfile,
        callback: Listener,
        watch: PublisherWatch,
    ) -> None:
        self.listeners = [callback]
        self._node, self._watch = node, watch
        self._subscription = node.create_subscription(message, name, self._receive, qos)
        self.topic_name: str = self._subscription.topic_name

    def _receive(self, message: Any) -> None:
        if self._watch.admits(self.topic_name):
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


class StreamNode(Node):
    """A node that publishes and obeys streams.

    Attributes:
        streams: that it publishes.
        inputs: streams that it obeys.
        publisher_watch: of the topics of both.
    """

    def __init__(self, name: str, **node_arguments: Any) -> None:
        self.streams: list[Stream] = []
        self.inputs: list[Input] = []
        super().__init__(name, **node_arguments)
        self.publisher_watch = PublisherWatch(self)

    def stream(self, topic: Topic) -> Stream:
        """Return a stream to publish."""
        stream = Stream(self, topic.message, topic.name, topic.qos)
        self.streams.append(stream)
        self.publisher_watch.add(stream.topic_name)
        return stream

    def listen(
        self, topic: Topic, callback: Callable[[Any], None], qos: QoSProfile | None = None
    ) -> None:
        """Call `callback` with the messages of a stream while it has one publisher."""
        qos, watch = qos or topic.qos, self.publisher_watch
        self.inputs.append(Input(self, topic.message, topic.name, qos, callback, watch))
        watch.add(self.inputs[-1].topic_name)

    def _warn(self, text: str) -> None:
        self.get_logger().warning(text)

    def listen_to_states(self, estimated: bool, callback: Callable[[Any], None]) -> None:
        """Call `callback` with the joint states that the node works on: estimated, or reported."""
        if estimated:
            names = JOINT_STATES.name, ESTIMATED_JOINT_STATES.name
            reported, estimates = map(self.resolve_topic_name, names)
            self.publisher_watch.estimates = reported, estimates
        self.listen(state_topic(estimated), callback)


def connect(nodes: Sequence[StreamNode]) -> None:
    """Connect the nodes of one process where an input has the topic of a stream.

    Connected inputs have no ROS subscription: nobody else's messages are obeyed. Of inputs whose
    publisher is in another process the first one subscribes for all.

    Args:
        nodes: in the order in which they get a message.
    """
    queue = Queue(nodes[0])
    sources: dict[str, Stream | Input] = {}
    for node in nodes:
        for stream in node.streams:
            stream.queue = queue
            sources[stream.topic_name] = stream
    for node in nodes:
        for each in node.inputs:
            source = sources.setdefault(each.topic_name, each)
            if source is not each:
                source.listeners += each.listeners
                each.unsubscribe()
