# SPDX-License-Identifier: Apache-2.0
"""What all nodes of this project have in common besides what rclpy gives them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, ClassVar

from rclpy.node import Node

from viability_bounds_pkg.exceptions import ArmSafetyError
from viability_bounds_pkg.ros.claim import Claim
from viability_bounds_pkg.ros.topics import Topic

_TOPICS_OF_ROS = ("/rosout", "/parameter_events", "/clock")


class ArmNode(Node):
    """A node that starts as a whole or not at all, and alone publishes what an arm obeys.

    Attributes:
        NAME: of the node, unless it is remapped.
        PARAMETERS: the dataclass of its parameters.
    """

    NAME: ClassVar[str]
    PARAMETERS: ClassVar[type]

    def __init__(self, **node_arguments: Any) -> None:
        self._claims: list[Claim] = []
        # With the services that `rqt_logger_level` uses.
        super().__init__(self.NAME, enable_logger_service=True, **node_arguments)

    @contextmanager
    def starting(self, *topics: Topic) -> Iterator[None]:
        """Claim topics, and take the node down again if what is done meanwhile is refused.

        Raises:
            TakenError: another node publishes one of the topics.
        """
        try:
            for topic in topics:
                self.claim("publishes", self.resolve_topic_name(topic.name))
            yield
        except ArmSafetyError:
            self.destroy_node()
            raise

    def claim(self, does: str, name: str) -> None:
        """Let no second node on this host do something while this one exists, see `Claim`."""
        self._claims.append(Claim(self, does, name))

    def announce(self, joints: Sequence[str], rate: float, what: str) -> None:
        """Log in one line what the node does, for which joints, and the topics that it uses.

        Args:
            joints: their names.
            rate: of the control loop, Hz.
            what: modes and methods, in words.
        """
        here = self.get_name(), self.get_namespace()
        published, heard = (
            " ".join(sorted(name for name, _ in topics if name not in _TOPICS_OF_ROS))
            for topics in (
                self.get_publisher_names_and_types_by_node(*here),
                self.get_subscriber_names_and_types_by_node(*here),
            )
        )
        self.get_logger().info(
            f"{len(joints)} joints ({joints[0]} to {joints[-1]}) at {rate:g} Hz, {what}; "
            f"subscribes to {heard}; publishes {published}"
        )

    def destroy_node(self) -> None:
        """Give up the claims, too."""
        for claim in self._claims:
            claim.close()
        super().destroy_node()
