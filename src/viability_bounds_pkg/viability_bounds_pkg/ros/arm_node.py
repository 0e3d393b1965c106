# SPDX-License-Identifier: Apache-2.0
"""Base class of all nodes: a start as a whole, warnings about topics and clock."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, ClassVar

from rclpy.clock import Clock, ClockType
from rclpy.exceptions import InvalidParameterTypeException

from viability_bounds_pkg.exceptions import ArmSafetyError
from viability_bounds_pkg.ros.given_parameters import given_parameters
from viability_bounds_pkg.ros.streams import StreamNode

CLOCK_TIMEOUT = 5.0
"""How long ``/clock`` may be silent at start before a node warns, s."""

_TYPE_PERIOD = 2.0  # s

_TOPICS_OF_ROS = ("/rosout", "/parameter_events", "/clock")

_OF_ROS = ("use_sim_time", "start_type_description_service", "qos_overrides")
"""Parameters that rclpy declares by itself."""


class StartError(ArmSafetyError, RuntimeError):
    """rclpy cannot start, or not make a node."""


class ArmNode(StreamNode):
    """A node that starts as a whole or not at all.

    Attributes:
        NAME: of the node, unless it is remapped.
        PARAMETERS: the dataclass of its parameters.
        given: values of parameters that the command line and files give the node.
    """

    NAME: ClassVar[str]
    PARAMETERS: ClassVar[type]

    def __init__(self, **node_arguments: Any) -> None:
        try:
            # With the services that `rqt_logger_level` uses.
            super().__init__(self.NAME, enable_logger_service=True, **node_arguments)
        except (RuntimeError, InvalidParameterTypeException) as error:  # security, use_sim_time
            raise StartError(str(error)) from error
        self.given = given_parameters(self.context, self.get_fully_qualified_name())
        for name in list(self.given):
            if name.startswith(_OF_ROS):
                del self.given[name]

    @contextmanager
    def starting(self) -> Iterator[None]:
        """Take the node down again if what is done meanwhile is refused."""
        try:
            yield
        except ArmSafetyError:
            self.destroy_node()
            raise

    def announce(self, joints: Sequence[str], rate: float, what: str) -> None:
        """Log in one line what the node does, for which joints, and the topics that it uses.

        Args:
            joints: their names.
            rate: of the control loop, Hz.
            what: modes and methods, in words.
        """
        published, heard = map(" ".join, self.topics_used())
        # A parameter of the scenario node, which robots' files have for all nodes.
        name = self.given.get("robot_name", "robot")
        self.get_logger().info(
            f"{name}, {len(joints)} joints ({joints[0]} to "
            f"{joints[-1]}) at {rate:g} Hz, {what}; subscribes to {heard}; publishes {published}"
        )
        if self.get_parameter("use_sim_time").value:
            self._expect_clock()
        self._watch_types(self.get_name(), self.get_namespace())

    def topics_used(self) -> tuple[list[str], list[str]]:
        """Return the names of the topics that the node publishes, and of those subscribed to."""
        here = self.get_name(), self.get_namespace()
        published, heard = (
            sorted(name for name, _ in topics if name not in _TOPICS_OF_ROS)
            for topics in (
                self.get_publisher_names_and_types_by_node(*here),
                self.get_subscriber_names_and_types_by_node(*here),
            )
        )
        return published, heard

    def _expect_clock(self) -> None:
        """Warn once if nothing publishes ``/clock``: stamps of what is published stay zero."""
        steady = Clock(clock_type=ClockType.STEADY_TIME)

        def warn_without_clock() -> None:
            timer.cancel()
            if not self.count_publishers("/clock"):
                self.get_logger().warning(
                    f"use_sim_time is true, but nothing has published /clock for {CLOCK_TIMEOUT:g}"
                    " s: set it to false, or start the simulation that publishes it"
                )

        timer = self.create_timer(CLOCK_TIMEOUT, warn_without_clock, clock=steady)

    def _watch_types(self, name: str, namespace: str) -> None:
        """Warn of topics that others use with another type: the middleware keeps them apart."""
        own = {
            topic: types[0]
            for topics in (
                self.get_publisher_names_and_types_by_node(name, namespace),
                self.get_subscriber_names_and_types_by_node(name, namespace),
            )
            for topic, types in topics
        }

        def warn_of_types() -> None:
            for topic, types in self.get_topic_names_and_types():
                others = [each for each in types if each != own.get(topic, each)]
                if others:
                    kind = own.pop(topic)
                    self.get_logger().warning(
                        f"'{topic}' is {kind} here; what is {' or '.join(others)} elsewhere is "
                        "not received"
                    )

        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(_TYPE_PERIOD, warn_of_types, clock=steady)
