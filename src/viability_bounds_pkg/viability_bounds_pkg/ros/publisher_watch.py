# SPDX-License-Identifier: Apache-2.0
"""Detects duplicate publishers of topics that may have one only."""

from __future__ import annotations

from rclpy.node import Node

from viability_bounds_pkg.ros.runtime import steady_timer

_PERIOD = 1.0


class PublisherWatch:
    """Counts the publishers of topics: once a second on the steady clock, and at each message.

    A node that was killed counts until the ROS graph forgets it, see ``fastdds.xml``. ROS does not
    tell which of the publishers sent a message. So where a message of something else comes, as of
    a gripper's driver among joint states, one of two publishers is taken for that one's, until
    their number changes.

    Args:
        node: logs a second publisher once when it has come, and once when it is gone.

    Attributes:
        rivals: nodes that publish the same topic, by topic; only topics with several.
    """

    def __init__(self, node: Node) -> None:
        self.rivals: dict[str, tuple[str, ...]] = {}
        self._topics: list[str] = []
        self._shared: set[str] = set()
        self._node = node
        # Faster than the node's own, which expands the name at each call.
        self._count = node.handle.get_count_publishers
        steady_timer(node, _PERIOD, self.check)

    def add(self, topic: str) -> None:
        """Watch a topic, too; its name is resolved."""
        self._topics.append(topic)

    def share(self, other: PublisherWatch) -> None:
        """Know what another node of the process knows: one may read the messages for all."""
        self._shared = other._shared

    @property
    def trouble(self) -> str:
        """Topics with several publishers in words, empty if there is none."""
        return "; ".join(
            f"{len(names)} publishers of '{topic}': {', '.join(names)}"
            for topic, names in self.rivals.items()
        )

    def admits(self, topic: str, of_other: bool = False) -> bool:
        """Return whether a message that has just come is to be obeyed: nobody else publishes.

        Args:
            topic: its name, resolved.
            of_other: whether the message is none that its reader is there for.
        """
        count = self._count(topic)
        if count != 2:
            self._shared.discard(topic)
        elif of_other:
            self._shared.add(topic)
        alone: bool = count <= 1 + (topic in self._shared)
        if alone == (topic in self.rivals):
            self._check_topic(topic)
        return alone and not (of_other and count > 1)

    def check(self) -> None:
        """Compare the graph with what was known."""
        for topic in self._topics:
            self._check_topic(topic)

    def _check_topic(self, topic: str) -> None:
        names: list[str] = []
        if self._count(topic) > 1 + (topic in self._shared):
            names = sorted(
                f"{each.node_namespace.rstrip('/')}/{each.node_name}"
                for each in self._node.get_publishers_info_by_topic(topic)
            )
        known = topic in self.rivals
        if len(names) > 1 + (topic in self._shared):
            self.rivals[topic] = tuple(names)
            if not known:
                self._node.get_logger().warning(
                    f"'{topic}' has {len(names)} publishers: {', '.join(names)}; stop all but "
                    "one, remap the topic of the others, or keep them apart by namespace or "
                    "ROS_DOMAIN_ID"
                )
        elif known:
            del self.rivals[topic]
            self._node.get_logger().info(f"'{topic}' has no rival publisher any more")
