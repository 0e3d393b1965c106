# SPDX-License-Identifier: Apache-2.0
"""Publishes scheduled messages before their time, and calls services in order."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence

from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.task import Future

from sim_bridge.nodes.scenario_messages import ScheduledMessage, ServiceRequest, refusals
from viability_bounds_pkg.exceptions import ArmSafetyError
from viability_bounds_pkg.ros.runtime import GOAL_QOS, set_stamp

_IN_FLIGHT_MAX = GOAL_QOS.depth - 2
"""Messages sent but not yet reported as received: a reader's queue is that long."""


class ScenarioRefused(ArmSafetyError, RuntimeError):
    """Another node refused a message or call of the scenario; the text says which and why."""


class ScheduledPublisher:
    """Publishes messages for one receiver before their time, as its queue permits.

    Args:
        node: publishes them.
        messages: in order of time.
    """

    def __init__(self, node: Node, messages: Sequence[ScheduledMessage]) -> None:
        self._publishers: dict[str, Publisher] = {}
        for message in messages:
            if message.topic not in self._publishers:
                self._publishers[message.topic] = node.create_publisher(
                    type(message.content), message.topic, GOAL_QOS
                )
        self._messages = messages
        self._sent = 0

    def without_subscriber(self) -> list[str]:
        """Return the topics without a subscriber."""
        return [
            topic for topic, out in self._publishers.items() if not out.get_subscription_count()
        ]

    def proceed(self, first: int, pending: int) -> bool:
        """Publish the messages that the receiver has room for.

        Args:
            first: stamp of the scenario's start, ns.
            pending: number of messages that the receiver reports as waiting for their time.

        Returns:
            Whether it has received all of them.
        """
        portion = self._messages[self._sent : pending + _IN_FLIGHT_MAX]
        for message in portion:
            set_stamp(message.header.stamp, first + message.delay)
            self._publishers[message.topic].publish(message.content)
        self._sent += len(portion)
        return pending >= len(self._messages)


class ServiceCaller:
    """Calls services one after the other.

    Args:
        node: calls them.
        requests: calls that will be made, as far as they are known.
    """

    def __init__(self, node: Node, requests: Iterable[ServiceRequest]) -> None:
        self._clients = {
            request.service: node.create_client(request.kind, request.service)
            for request in requests
        }
        self._waiting: deque[tuple[str, ServiceRequest]] = deque()
        self._answer: Future | None = None

    def missing(self) -> list[str]:
        """Return the services that are not available."""
        return [name for name, client in self._clients.items() if not client.service_is_ready()]

    def add(self, when: str, request: ServiceRequest) -> None:
        """Call a service after those added before; `when` is part of the error of a refusal."""
        self._waiting.append((when, request))

    def drop(self) -> None:
        """Discard the calls that have not been answered."""
        self._waiting.clear()
        self._answer = None

    def proceed(self) -> bool:
        """Make the next call when the last is answered; return whether all have been.

        Raises:
            ScenarioRefused: one was refused.
        """
        while self._waiting:
            when, request = self._waiting[0]
            if self._answer is None:
                self._answer = self._clients[request.service].call_async(request.content)
            if not self._answer.done():
                return False
            response, self._answer = self._answer.result(), None
            self._waiting.popleft()
            reasons = "; ".join(refusals(request, response))
            if reasons:
                raise ScenarioRefused(f"{when}{request.service} refused: {reasons}")
        return True

    @property
    def awaited(self) -> list[str]:
        """The answer that is missing, if any."""
        return [f"answer of {self._waiting[0][1].service}"] if self._waiting else []
