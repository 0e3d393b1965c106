# SPDX-License-Identifier: Apache-2.0
"""Publishes a node's status on ``/diagnostics``."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node

from viability_bounds_pkg.ros.publisher_watch import PublisherWatch
from viability_bounds_pkg.ros.runtime import steady_timer
from viability_bounds_pkg.ros.topics import DIAGNOSTICS

Report = Callable[[], tuple[bytes, str, dict[str, Any]]]
"""Returns level, message and values of a status."""

DIAGNOSTICS_PERIOD = 0.5
"""Between two messages of a node, s; tests, which wait for them, shorten it."""


class Diagnostics:
    """Publishes one status on ``/diagnostics``, regularly and when asked.

    Args:
        node: the publishing node; its name with the namespace, as in ``left/bounds_node``, is the
            status' name, so that two arms are told apart.
        report: returns level (a constant of ``DiagnosticStatus``), a message and the values.
        watch: its topics with several publishers are reported, too, as a warning.
    """

    def __init__(self, node: Node, report: Report, watch: PublisherWatch | None = None) -> None:
        self._node, self._report, self._watch = node, report, watch
        self._publisher = DIAGNOSTICS.publisher(node)
        self._timer = steady_timer(node, DIAGNOSTICS_PERIOD, self.publish)

    def publish(self) -> None:
        """Send the status now."""
        level, message, values = self._report()
        if self._watch is not None:
            trouble = self._watch.trouble
            values["topics_with_several_publishers"] = trouble or "none"
            if trouble:
                level = max(level, DiagnosticStatus.WARN)
                message += f"; {trouble}"
        status = DiagnosticStatus(
            level=level,
            name=self._node.get_fully_qualified_name().removeprefix("/"),
            message=message,
            hardware_id=self._node.get_namespace(),
            values=[KeyValue(key=key, value=_text(value)) for key, value in values.items()],
        )
        array = DiagnosticArray(status=[status])
        array.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(array)


def _text(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.9g}"
    if isinstance(value, np.ndarray):
        return " ".join(f"{item:.9g}" for item in value)
    if isinstance(value, Counter):
        return " ".join(f"{key}: {count};" for key, count in value.items()) or "none"
    return str(value)
