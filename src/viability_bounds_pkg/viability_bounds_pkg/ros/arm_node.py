# SPDX-License-Identifier: Apache-2.0
"""Base class of all nodes: streams, a start as a whole, warnings about topics and clock."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, ClassVar

from rclpy.exceptions import InvalidParameterTypeException
from rclpy.executors import Executor
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.task import Future

from viability_bounds_pkg.exceptions import ArmSafetyError
from viability_bounds_pkg.parameter_files import given_parameters
from viability_bounds_pkg.ros.publisher_watch import PublisherWatch
from viability_bounds_pkg.ros.runtime import steady_timer
from viability_bounds_pkg.ros.streams import Input, Queue, Stream
from viability_bounds_pkg.ros.topics import Topic, state_topic

CLOCK_TIMEOUT = 5.0
"""How long ``/clock`` may be silent at start before a node warns, s."""

LOOK_PERIOD = 0.2
"""After which a program looks whether ROS has been shut down, s."""

_TYPE_PERIOD = 2.0  # s

_TOPICS_OF_ROS = ("/rosout", "/parameter_events", "/clock")

_OF_ROS = ("use_sim_time", "start_type_description_service", "qos_overrides")
"""Parameters that rclpy declares by itself."""


class StartError(ArmSafetyError, RuntimeError):
    """rclpy cannot start, or not make a node."""


class ArmNode(Node):
    """A node that starts as a whole or not at all, publishes streams and obeys others.

    Attributes:
        NAME: of the node, unless it is remapped.
        PARAMETERS: the dataclass of its parameters.
        given: values of parameters that the command line and files give the node.
        streams: that it publishes.
        inputs: streams that it obeys.
        publisher_watch: of the topics of both.
        uses_estimates: whether it needs ``estimated_joint_states``.
    """

    NAME: ClassVar[str]
    PARAMETERS: ClassVar[type]

    def __init__(self, **node_arguments: Any) -> None:
        try:
            # With the services that `rqt_logger_level` uses.
            super().__init__(self.NAME, enable_logger_service=True, **node_arguments)
        except (RuntimeError, InvalidParameterTypeException) as error:  # security, use_sim_time
            raise StartError(str(error)) from error
        given = given_parameters(self.context, self.get_fully_qualified_name())
        self.given = {name: value for name, value in given.items() if not name.startswith(_OF_ROS)}
        self.streams: list[Stream] = []
        self.inputs: list[Input] = []
        self.uses_estimates = False
        self.publisher_watch = PublisherWatch(self)

    @contextmanager
    def starting(self) -> Iterator[None]:
        """Take the node down again if what is done meanwhile is refused."""
        try:
            yield
        except ArmSafetyError:
            self.destroy_node()
            raise

    def stream(self, topic: Topic) -> Stream:
        """Return a stream to publish."""
        stream = Stream(self, topic)
        self.streams.append(stream)
        self.publisher_watch.add(stream.topic_name)
        return stream

    def listen(
        self,
        topic: Topic,
        callback: Callable[[Any], None],
        qos: QoSProfile | None = None,
        joints: Sequence[str] = (),
    ) -> None:
        """Call `callback` with the messages of a stream while it has one publisher.

        Args:
            topic: of the stream.
            callback: gets the messages.
            qos: of the subscription; None for that of the topic.
            joints: names; a publisher of messages that have none of them does not count.
        """
        known = set(joints)

        def of_other(message: Any) -> bool:
            return bool(known) and known.isdisjoint(message.name)

        obeyed = Input(self, topic, callback, self.publisher_watch, qos, of_other)
        self.inputs.append(obeyed)
        self.publisher_watch.add(obeyed.topic_name)

    def listen_to_states(
        self, estimated: bool, callback: Callable[[Any], None], joints: Sequence[str]
    ) -> None:
        """Call `callback` with the joint states that the node works on: estimated, or reported."""
        self.uses_estimates = estimated
        self.listen(state_topic(estimated), callback, joints=joints)

    def run_once(self, executor: Executor, ended: Future) -> None:
        """Run callbacks for a while, at most until `ended` is done.

        A driver whose library waits for the arm replaces it by one control period.
        """
        executor.spin_until_future_complete(ended, timeout_sec=LOOK_PERIOD)

    def announce(self, joints: Sequence[str], rate: float, what: str) -> None:
        """Log in one line what the node does, for which joints, and the topics that it uses.

        Args:
            joints: their names.
            rate: of the control loop, Hz.
            what: modes and methods, in words.
        """
        here = self.get_name(), self.get_namespace()
        published = dict(self.get_publisher_names_and_types_by_node(*here))
        heard = dict(self.get_subscriber_names_and_types_by_node(*here))
        shown = (
            " ".join(name for name in sorted(topics) if name not in _TOPICS_OF_ROS)
            for topics in (heard, published)
        )
        # A parameter of the scenario node, which robots' files have for all nodes.
        robot = self.given.get("robot_name", "robot")
        self.get_logger().info(
            f"{robot}, {len(joints)} joints ({joints[0]} to {joints[-1]}) at {rate:g} Hz, {what}; "
            "subscribes to {}; publishes {}".format(*shown)
        )
        if self.get_parameter("use_sim_time").value:
            self._expect_clock()
        self._watch_types({name: types[0] for name, types in (published | heard).items()})

    def _expect_clock(self) -> None:
        """Warn once if nothing publishes ``/clock``: stamps of what is published stay zero."""

        def warn_without_clock() -> None:
            timer.cancel()
            if not self.count_publishers("/clock"):
                self._warn(
                    f"use_sim_time is true, but nothing has published /clock for {CLOCK_TIMEOUT:g}"
                    " s: set it to false, or start the simulation that publishes it"
                )

        timer = steady_timer(self, CLOCK_TIMEOUT, warn_without_clock)

    def _watch_types(self, own: dict[str, str]) -> None:
        """Warn of topics that others use with another type: the middleware keeps them apart.

        Args:
            own: types by topic.
        """

        def warn_of_types() -> None:
            for topic, types in self.get_topic_names_and_types():
                others = [each for each in types if each != own.get(topic, each)]
                if others:
                    self._warn(
                        f"'{topic}' is {own.pop(topic)} here; what is {' or '.join(others)} "
                        "elsewhere is not received"
                    )

        steady_timer(self, _TYPE_PERIOD, warn_of_types)

    def _warn(self, text: str) -> None:
        self.get_logger().warning(text)


def connect(nodes: Sequence[ArmNode]) -> None:
    """Connect the nodes of one process where an input has the topic of a stream.

    Connected inputs have no ROS subscription: nobody else's messages are obeyed. Of inputs whose
    publisher is in another process the first one subscribes for all.

    Args:
        nodes: in the order in which they get a message.
    """
    queue = Queue(nodes[0])
    sources: dict[str, Stream | Input] = {}
    for node in nodes:
        node.publisher_watch.share(nodes[0].publisher_watch)
        for stream in node.streams:
            stream.queue = queue
            sources[stream.topic_name] = stream
    for node in nodes:
        for each in node.inputs:
            each.queue = queue
            source = sources.setdefault(each.topic_name, each)
            if source is not each:
                source.listeners += each.listeners
                each.unsubscribe()
