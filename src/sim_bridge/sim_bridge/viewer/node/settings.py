# SPDX-License-Identifier: Apache-2.0
"""Reads and sets the parameters of the other nodes that the page shows."""

from __future__ import annotations

from typing import Any

from rcl_interfaces.srv import GetParameters, SetParameters
from rclpy.node import Node
from rclpy.parameter import Parameter, parameter_value_to_python
from rclpy.task import Future

NAMES = {
    "bounds_node": ("method",),
    "controller_node": ("safety_filter", "integral_action"),
}
"""Parameters shown, by node."""

_PERIOD = 20
"""Pictures between two looks at the values."""


class RemoteSettings:
    """Knows what the parameters are now, by asking now and then, and changes them.

    Args:
        node: calls the services.

    Attributes:
        values: by node and name; only those known.
        refused: why the last change was refused; empty if it was not.
    """

    def __init__(self, node: Node) -> None:
        self.values: dict[tuple[str, str], Any] = {}
        self.refused = ""
        self._get = {
            name: node.create_client(GetParameters, f"{name}/get_parameters") for name in NAMES
        }
        self._set = {
            name: node.create_client(SetParameters, f"{name}/set_parameters") for name in NAMES
        }
        self._asked: dict[str, Future] = {}
        self._changing: Future | None = None
        self._count = 0

    def choose(self, node: str, name: str, value: Any) -> None:
        """Set a parameter of a node."""
        if not self._set[node].service_is_ready():
            self.refused = f"{node} does not answer"
            return
        request = SetParameters.Request(
            parameters=[Parameter(name, value=value).to_parameter_msg()]
        )
        self._changing = self._set[node].call_async(request)
        self.values[node, name] = value  # until it is asked for again

    def proceed(self) -> None:
        """Take answers that have come; ask again when it is time."""
        if self._changing is not None and self._changing.done():
            results = self._changing.result().results
            self.refused = "; ".join(each.reason for each in results if not each.successful)
            self._changing, self._count = None, 0
        for node, asked in list(self._asked.items()):
            if asked.done():
                del self._asked[node]
                for name, value in zip(NAMES[node], asked.result().values, strict=False):
                    self.values[node, name] = parameter_value_to_python(value)
        if self._count == 0 and self._changing is None:
            for node, client in self._get.items():
                if node not in self._asked and client.service_is_ready():
                    request = GetParameters.Request(names=list(NAMES[node]))
                    self._asked[node] = client.call_async(request)
        self._count = (self._count + 1) % _PERIOD
