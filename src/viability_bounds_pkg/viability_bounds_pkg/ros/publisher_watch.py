# SPDX-License-Identifier: Apache-2.0
"""Second publishers of topics that may have one only, told and not heard; a missing estimator."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable

from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.topic_endpoint_info import TopicEndpointInfo

from viability_bounds_pkg.ros.direct_delivery import DirectDelivery
from viability_bounds_pkg.ros.topics import ESTIMATED_JOINT_STATES, JOINT_STATES

_PERIOD = 1.0
_GHOST_TIME = 20.0
"""How long a node that was killed, or has just ended, may stay in the graph, s."""
_NAMELESS_TIME = 1.0
"""How long a node may publish a topic before its name is known, s."""
_AGAIN = 0.02
"""How often messages of a topic with several publishers make it look, s."""
_PATIENCE = 3
"""How many looks in a row must find no estimator: others may start first."""
_UNKNOWN = "_UNKNOWN_"
"""Ends the names that rmw gives nodes which have not told theirs."""


class PublisherWatch:
    """Looks at the ROS graph for topics that more than one node publishes.

    `Claim` keeps two nodes of this project on one host apart. This sees the others, too:
    drivers of the user, nodes on other hosts, a ``ros2 topic pub``. It looks once a second on the
    steady clock; counting the publishers of a topic takes some microseconds. Publishers of one
    and the same name count only when two of them have been there for `_GHOST_TIME`: mostly one has
    replaced the other, perhaps again and again, and the others have not left the graph yet.

    Args:
        node: logs a second publisher once when it has come, and once when it is gone.
        topics: names of the topics, before remapping.
        needs_estimates: whether the node works on estimated joint states: then it is also logged,
            once each time, that there are joint states, but nobody to estimate them.

    Attributes:
        rivals: nodes that publish the same topic, by topic; only topics with several.
    """

    def __init__(
        self, node: Node, topics: Iterable[str], *, needs_estimates: bool = False
    ) -> None:
        self.rivals: dict[str, tuple[str, ...]] = {}
        self._needs_estimates, self._without_estimates = needs_estimates, 0
        self._reported, self._estimated = (
            node.resolve_topic_name(topic.name) for topic in (JOINT_STATES, ESTIMATED_JOINT_STATES)
        )
        self._node = node
        self._direct: DirectDelivery | None = getattr(node, "direct_delivery", None)
        # Held by the interpreter's lock, so that no other thread destroys the node meanwhile.
        self._count = node.handle.get_count_publishers
        self._topics = [node.resolve_topic_name(topic) for topic in topics]
        # When a publisher without a name was first seen, and each of several, by its identity.
        self._nameless: dict[str, float] = {}
        self._seen: dict[str, dict[tuple[int, ...], float]] = {}
        self._looked: dict[str, float] = {}
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        node.create_timer(_PERIOD, self.look, clock=steady)

    @property
    def trouble(self) -> str:
        """Topics with several publishers in words, and a missing estimator; empty without."""
        return "; ".join(filter(None, (self.several, self.missing)))

    @property
    def missing(self) -> str:
        """Says that the estimator is missing, empty if it is not."""
        if self._without_estimates < _PATIENCE:
            return ""
        return f"'{self._reported}' has a publisher, '{self._estimated}' has none"

    @property
    def several(self) -> str:
        """Topics with several publishers in words, empty if there is none."""
        return "; ".join(
            f"{len(names)} publishers of '{topic}': {', '.join(names)}"
            for topic, names in self.rivals.items()
        )

    def admits(self, topic: str) -> bool:
        """Return whether a message that came just now is to be obeyed: nobody else publishes.

        Neither is one while it is not known yet who publishes besides. So messages of several
        publishers are never mixed; a node that was killed and has been started again is heard when
        its name is known.

        Args:
            topic: its name, resolved.
        """
        # On the control path. A subscription counts its publishers faster, but a little after it
        # takes their messages: the graph has a publisher before. What is delivered directly does
        # not come from elsewhere: as soon as another publisher matches, nothing is.
        within = self._direct is not None and self._direct.within(topic)
        if within or self._count(topic) <= 1:
            if self._looked or self.rivals:
                self._looked.pop(topic, None)
                if topic in self.rivals:
                    self.look()
            return True
        now = time.monotonic()
        if now - self._looked.get(topic, -math.inf) > _AGAIN:
            self._looked[topic] = now
            self._note(topic)
        return topic not in self.rivals and topic not in self._nameless

    def look(self) -> None:
        """Compare the graph with what was known."""
        if self._needs_estimates:
            self._look_for_estimator()
        for topic in self._topics:
            if self._node.count_publishers(topic) > 1:
                self._note(topic)
                continue
            self._seen.pop(topic, None)
            self._nameless.pop(topic, None)
            if self.rivals.pop(topic, None):
                self._node.get_logger().info(f"'{topic}' has no second publisher any more")

    def _look_for_estimator(self) -> None:
        count = self._node.count_publishers
        if count(self._estimated) or not count(self._reported):
            self._without_estimates = 0
            return
        self._without_estimates += 1
        if self._without_estimates == _PATIENCE:
            self._node.get_logger().warning(
                f"{self.missing}: start estimator_node, or set use_estimated_states to false"
            )

    def _note(self, topic: str) -> None:
        publishers = self._node.get_publishers_info_by_topic(topic)
        names = sorted(map(_name, publishers))
        known, now = topic in self.rivals, time.monotonic()
        seen = self._seen.get(topic, {})
        identities = [tuple(each.endpoint_gid) for each in publishers]
        seen = self._seen[topic] = {each: seen.get(each, now) for each in identities}
        if len(names) < 2 or any(_UNKNOWN in name for name in names):
            # A node tells its name a moment after its topics.
            since = self._nameless.setdefault(topic, now)
            if len(names) < 2 or (not known and now - since < _NAMELESS_TIME):
                return
        else:
            self._nameless.pop(topic, None)
            together = now - sorted(map(seen.__getitem__, identities))[1]
            if len(set(names)) == 1 and together < _GHOST_TIME:
                if self.rivals.pop(topic, None):
                    self._node.get_logger().info(f"'{topic}' is published by {names[0]} alone")
                return
        self.rivals[topic] = tuple(names)
        if not known:
            self._node.get_logger().warning(
                f"'{topic}' has {len(names)} publishers: {', '.join(names)}; stop all but one, or "
                "keep them apart by namespace or ROS_DOMAIN_ID"
            )


def _name(publisher: TopicEndpointInfo) -> str:
    """Return the fully qualified name of the node that publishes."""
    namespace: str = publisher.node_namespace
    return f"{namespace.rstrip('/')}/{publisher.node_name}"
