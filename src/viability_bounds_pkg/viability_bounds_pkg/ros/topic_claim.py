# SPDX-License-Identifier: Apache-2.0
"""One publisher for a topic that an arm obeys: a second node on this host does not start."""

from __future__ import annotations

import socket
import struct

from rclpy.node import Node

from viability_bounds_pkg.exceptions import ArmSafetyError


class TopicTakenError(ArmSafetyError, RuntimeError):
    """Another node on this host publishes the topic in the same ROS domain."""


class TopicClaim:
    """The right to publish a topic in a ROS domain, as long as this object is open.

    A Unix socket with an abstract address holds it: the system lets one process have it, and frees
    it when the process ends, however that happens. Nodes on other hosts, and nodes of others, do
    not take part.

    Args:
        node: that is to publish it.
        topic: name of the topic, before remapping.

    Raises:
        TopicTakenError: another node has it.
    """

    def __init__(self, node: Node, topic: str) -> None:
        name = node.resolve_topic_name(topic)
        domain = node.context.get_domain_id()
        address = f"\0viability_bounds {domain} {name}"
        self._socket = socket.socket(socket.AF_UNIX)
        try:
            self._socket.bind(address)
            self._socket.listen()
        except OSError as error:
            self._socket.close()
            raise TopicTakenError(
                f"{_holder(address)} publishes '{name}' in ROS domain {domain} already: stop it, "
                "or set another ROS_DOMAIN_ID or namespace (-r __ns:=/name)"
            ) from error

    def close(self) -> None:
        """Let another node have the topic."""
        self._socket.close()


def _holder(address: str) -> str:
    """Return which process holds an address, in words."""
    with socket.socket(socket.AF_UNIX) as other:
        try:
            other.connect(address)
        except OSError:
            return "another node"
        credentials = other.getsockopt(
            socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i")
        )
        return f"another node (process {struct.unpack('3i', credentials)[0]})"
