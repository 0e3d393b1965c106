# SPDX-License-Identifier: Apache-2.0
"""Runs a scenario to its end, and writes the report."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node

from sim_bridge.nodes.scenario_node import ScenarioNode
from sim_bridge.nodes.scenario_sender import ScenarioRefused
from viability_bounds_pkg.ros.runtime import leave, make_executor, report_refusal

_SHOW_PERIOD = 0.5


def play(node: ScenarioNode, others: Sequence[Node] = (), *, quiet: bool = False) -> None:
    """Run the scenario to its end and print its state.

    Args:
        node: the scenario.
        others: nodes to run in the same process.
        quiet: print nothing.

    Raises:
        TimeoutError: the other nodes did not start, or stopped answering.
        ScenarioRefused: another node refused a message or call of the scenario.
        ExternalShutdownException: shut down before the end.
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
        if (node.listener.stamp, node.phase) != progress:
            progress, moved_at = (node.listener.stamp, node.phase), now
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


def main(args: list[str] | None = None) -> int:
    """Play a scenario; with ``--out DIRECTORY`` also write its report.

    Returns:
        0 when no limit was broken, 1 when one was, 2 when the scenario could not be played.
    """
    argv = rclpy.utilities.remove_ros_args(args=sys.argv if args is None else args)
    try:
        out = _output_directory(argv)
        rclpy.init(args=args)
        node = ScenarioNode()
    except Exception as error:
        rclpy.try_shutdown()
        report_refusal(error)
        return 2
    try:
        play(node)
        if out is None:
            return 0
        from sim_bridge.scenario.report import write_report  # matplotlib takes a second to import

        bounds = node.listener.diagnostics["bounds_node"]
        kept = write_report(out, node.config, node.recorded_run(), node.robot, bounds)
        return 0 if kept else 1
    except (TimeoutError, ScenarioRefused) as error:
        report_refusal(error)
        return 2
    except (KeyboardInterrupt, ExternalShutdownException):
        return 130
    finally:
        leave(node)


def _output_directory(argv: list[str]) -> Path | None:
    """Return the value of ``--out``, or None without it."""
    if "--out" not in argv:
        return None
    value = argv[argv.index("--out") + 1 :][:1]
    if not value:
        raise ValueError("--out needs a directory")
    return Path(value[0])


if __name__ == "__main__":
    sys.exit(main())
