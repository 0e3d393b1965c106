# SPDX-License-Identifier: Apache-2.0
"""Rights that one node holds: a second one on this host does not start."""

from __future__ import annotations

import socket
import struct

from rclpy.node import Node

from viability_bounds_pkg.exceptions import ArmSafetyError


class TakenError(ArmSafetyError, RuntimeError):
    """Another node on this host holds the right in the same ROS domain."""


class Claim:
    """The right to do something in a ROS domain, as long as this object is open.

    A Unix socket with an abstract address holds it: the system lets one process have it, and frees
    it when the process ends, however that happens. Nodes on other hosts, and nodes of others, do
    not take part; `PublisherWatch` sees those.

    Args:
        node: that is to do it.
        does: what, such as "publishes".
        name: fully qualified name of the topic or node that it does it to.

    Raises:
        TakenError: another node has it.
    """

    def __init__(self, node: Node, does: str, name: str) -> None:
        domain = node.context.get_domain_id()
        address = f"\0viability_bounds {domain} {name}"
        self._socket = socket.socket(socket.AF_UNIX)
        try:
            self._socket.bind(address)
            self._socket.listen()
        except OSError as error:
            self._socket.close()
            raise TakenError(
                f"{_holder(address)} {does} '{name}' in ROS domain {domain} already: stop it, "
                "or set another ROS_DOMAIN_ID or namespace (-r __ns:=/name)"
            ) from error

    def close(self) -> None:
        """Let another node have it."""
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
