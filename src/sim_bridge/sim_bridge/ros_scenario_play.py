"""Runs a scenario to its end."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node

from viability_bounds_pkg.ros_runtime import make_executor

if TYPE_CHECKING:
    from sim_bridge.scenario_node import ScenarioNode

_SHOW_PERIOD = 0.5


def play(node: ScenarioNode, others: Sequence[Node] = (), *, quiet: bool = False) -> None:
    """Run the scenario to its end, showing a live line.

    Args:
        node: the scenario.
        others: nodes to run in the same process.
        quiet: show nothing.

    Raises:
        TimeoutError: the other nodes did not come up, or stopped answering.
        ScenarioRefused: another node refused what the scenario asks of it.
        ExternalShutdownException: told to stop before the end.
    """
    executor = make_executor(node.context)
    for each in (node, *others):
        executor.add_node(each)
    terminal = sys.stdout.isatty()
    shown_at = -math.inf
    progress, moved_at = None, time.monotonic()
    while not node.done and rclpy.ok(context=node.context):
        executor.spin_once(timeout_sec=0.1)
        now = time.monotonic()
        if (node.heard.stamp, node.phase) != progress:
            progress, moved_at = (node.heard.stamp, node.phase), now
        elif now - moved_at > node.config.ready_timeout:
            phase = node.phase.name.lower().replace("_", " ")
            awaited = ": there is no " + ", no ".join(node.awaited()) if node.awaited() else ""
            raise TimeoutError(
                f"nothing has moved for {node.config.ready_timeout:g} s ({phase}{awaited})"
            )
        if not quiet and now - shown_at > _SHOW_PERIOD:
            shown_at = now
            print(node.live_line(), end="\r" if terminal else "\n", flush=True)
    if node.failure is not None:
        raise node.failure
    if not node.done:
        raise ExternalShutdownException
    if not quiet:
        print(node.live_line(), flush=True)
