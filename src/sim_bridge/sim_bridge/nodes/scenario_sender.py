"""Sends what a scenario sends: messages ahead of their time, and calls of services."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence

from rclpy.node import Node

from sim_bridge.nodes.scenario_messages import Letter, Request, refusals
from viability_bounds_pkg.exceptions import ArmSafetyError
from viability_bounds_pkg.ros.runtime import GOAL_QOS, set_stamp

_AT_ONCE = GOAL_QOS.depth - 2
"""How many messages may be on their way: a reader keeps no more than its depth."""


class ScenarioRefused(ArmSafetyError, RuntimeError):
    """Another node does not do what the scenario asks; its text says which and why."""


class Outbox:
    """Messages for one receiver, sent ahead in portions that it can take.

    Args:
        node: publishes them.
        letters: in order of time.
    """

    def __init__(self, node: Node, letters: Sequence[Letter]) -> None:
        self._publishers = {}
        for letter in letters:
            if letter.topic not in self._publishers:
                self._publishers[letter.topic] = node.create_publisher(
                    type(letter.message), letter.topic, GOAL_QOS
                )
        self._letters = letters
        self._sent = 0

    def unheard(self) -> list[str]:
        """Return the topics that nobody listens to."""
        return [
            topic for topic, out in self._publishers.items() if not out.get_subscription_count()
        ]

    def proceed(self, first: int, pending: int) -> bool:
        """Send what there is room for.

        Args:
            first: stamp of the scenario's beginning, ns.
            pending: how many messages the receiver says that it keeps for later.

        Returns:
            Whether it has all of them.
        """
        portion = self._letters[self._sent : pending + _AT_ONCE]
        for letter in portion:
            set_stamp(letter.header.stamp, first + letter.delay)
            self._publishers[letter.topic].publish(letter.message)
        self._sent += len(portion)
        return pending >= len(self._letters)


class Caller:
    """Calls services one after the other.

    Args:
        node: calls them.
        requests: calls that will be made, as far as they are known.
    """

    def __init__(self, node: Node, requests: Iterable[Request]) -> None:
        self._clients = {
            request.service: node.create_client(request.kind, request.service)
            for request in requests
        }
        self._waiting: deque[tuple[str, Request]] = deque()
        self._answer = None

    def missing(self) -> list[str]:
        """Return the services that are not there."""
        return [name for name, client in self._clients.items() if not client.service_is_ready()]

    def add(self, when: str, request: Request) -> None:
        """Call a service after those that were added before; `when` is told if it is refused."""
        self._waiting.append((when, request))

    def drop(self) -> None:
        """Forget the calls that have not been answered."""
        self._waiting.clear()
        self._answer = None

    def proceed(self) -> bool:
        """Go on; return whether all calls have been answered.

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
        """The service that has not answered, if there is one."""
        return [f"answer of {self._waiting[0][1].service}"] if self._waiting else []
