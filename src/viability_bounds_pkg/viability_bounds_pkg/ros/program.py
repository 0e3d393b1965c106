# SPDX-License-Identifier: Apache-2.0
"""Nodes as a program: its command line, their start, their end by a signal."""

from __future__ import annotations

import argparse
import gc
import os
import signal
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from itertools import pairwise

import rclpy
from rclpy.executors import Executor, ExternalShutdownException
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future

from viability_bounds_pkg.cli.command_line import Parser
from viability_bounds_pkg.exceptions import ArmSafetyError
from viability_bounds_pkg.parameter import parameter_table
from viability_bounds_pkg.parameter_files import read_sections, remember_arguments
from viability_bounds_pkg.ros.arm_node import ArmNode, StartError, connect
from viability_bounds_pkg.ros.runtime import (
    EventsExecutor,
    make_executor,
    settle_dds,
    steady_timer,
)

SIGNAL_CHECK_PERIOD = 0.05
"""Of programs that are ended together none is to find another one silent, after 75 ms, s."""

_LEAVE_TIMEOUT = 5
"""How long a node may take to leave the graph, s."""


def spin(executor: Executor, node: ArmNode) -> None:
    """Run callbacks until the context is shut down or SIGINT or SIGTERM comes.

    ``EventsExecutor.spin()`` of rclpy 7.1 runs no callback; a wait without time-out does not see
    signals, and one with a time-out goes on while there is something to do, in lockstep for ever.
    So a timer looks for signals, and ends a wait for a future. A signal lets the callback that it
    interrupts end: it may be about to publish. Call it from the main thread.

    Args:
        executor: runs the callbacks.
        node: one of its nodes, whose `run_once` is called again and again.
    """
    signals: list[int] = []
    for each in (signal.SIGINT, signal.SIGTERM):
        signal.signal(each, lambda number, _: signals.append(number))
    told: Future = Future()

    def end_wait() -> None:
        if signals:
            told.set_result(None)

    steady_timer(node, SIGNAL_CHECK_PERIOD, end_wait)
    while rclpy.ok(context=node.context) and not told.done():
        node.run_once(executor, told)


def node_parser(kind: type[ArmNode]) -> Parser:
    """Return the parser of a node's own arguments, whose help lists its parameters."""
    lines = (
        f"  {row.name}: {row.description}" + (f" [{row.constraints}]" if row.constraints else "")
        for row in parameter_table(kind.PARAMETERS)
    )
    return _parser(kind.NAME, kind.__doc__, "\n".join(("parameters:", *lines)))


def stack_parser(name: str, description: str, kinds: Sequence[type[ArmNode]]) -> Parser:
    """Return the parser of a program's own arguments that runs nodes of several kinds."""
    names = ", ".join(kind.NAME for kind in kinds)
    return _parser(name, description, f"nodes, whose --help lists their parameters: {names}")


def _parser(name: str, description: str | None, epilog: str) -> Parser:
    return Parser(
        prog=name,
        description=(description or "").strip().split("\n")[0],
        usage="%(prog)s [options] [--ros-args [--params-file FILE] [-p [NODE:]NAME:=VALUE] "
        "[-r [NODE:]FROM:=TO] [--log-level LEVEL]]",
        epilog=epilog,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )


def initialise(parser: Parser, args: Sequence[str] | None = None) -> argparse.Namespace:
    """Initialise rclpy with a command line; return what its other arguments say.

    Args:
        parser: of the arguments that are not for ROS.
        args: the command line, as `sys.argv`; None for that of the process.

    Raises:
        ArmSafetyError: arguments for ROS, or a parameter file, that cannot be used.
    """
    arguments = list(sys.argv if args is None else args)
    for word, path in pairwise(arguments):
        if word == "--params-file":
            read_sections(path)  # rcl's own errors do not tell the line
    settle_dds(os.environ)
    try:
        options = parser.parse_args(rclpy.utilities.remove_ros_args(args=arguments)[1:])
        # Its own signal handlers would shut down the context in the middle of a callback.
        rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
    except Exception as error:  # rclpy's own classes differ between releases
        raise StartError(f"arguments for ROS cannot be used: {error}") from error
    remember_arguments(rclpy.get_default_context(), arguments)
    return options


def run(make_node: type[ArmNode], args: list[str] | None = None) -> int:
    """Run one node; return the exit code, as `run_together`."""
    return run_together(node_parser(make_node), lambda: [make_node()], args)


def run_together(
    parser: Parser,
    make_nodes: Callable[[], Iterable[ArmNode]],
    args: list[str] | None = None,
) -> int:
    """Start nodes in one process, run them on one executor until they are told to stop.

    Args:
        parser: of the program's own arguments.
        make_nodes: makes the nodes, one after the other, in the order in which they get messages.
        args: the command line; None for that of the process.

    Returns:
        The exit code: 0 after SIGINT, SIGTERM or shutdown; 1 when a node cannot start, after one
        line on stderr that says why.
    """
    nodes: list[ArmNode] = []
    executor: Executor | None = None
    told: list[int] = []

    def interrupt(number: int, _: object) -> None:
        told.append(number)
        raise KeyboardInterrupt

    try:
        initialise(parser, args)
        # What is raised while a callback of compiled code runs is lost.
        signal.signal(signal.SIGINT, interrupt)
        for node in make_nodes():
            nodes.append(node)
        connect(nodes)
        executor = prepared_executor(nodes)
        if not told:
            spin(executor, nodes[0])
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except ArmSafetyError as error:
        report_refusal(error)
        return 1
    finally:
        # The program is ending: a further signal must not change its exit code.
        for each in (signal.SIGINT, signal.SIGTERM):
            signal.signal(each, lambda *_: None)
        with time_to_leave():
            leave(*nodes)
            executor = None  # with it goes what Fast DDS has of the process
        gc.unfreeze()
    return 0


def prepared_executor(nodes: Sequence[ArmNode]) -> Executor:
    """Return an executor with nodes that are complete."""
    executor = make_executor()
    if EventsExecutor is None:
        nodes[0].get_logger().warning(
            "rclpy has no EventsExecutor; the single-threaded one adds about 2 ms a cycle"
        )
    for node in nodes:
        executor.add_node(node)
    # What exists by now lives until the end: the collector need not visit it in the control loop.
    gc.collect()
    gc.freeze()
    return executor


@contextmanager
def time_to_leave() -> Iterator[None]:
    """Limit the time for leaving ROS at the end of a process; enter it in the main thread.

    When another process leaves at the same moment, Fast DDS 2.14 may wait for ever inside a call,
    so that no Python code runs any more. So the system ends the process if this takes too long.
    """
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.alarm(_LEAVE_TIMEOUT)
    yield
    signal.alarm(0)


def leave(*nodes: Node) -> None:
    """Destroy nodes and shut ROS down."""
    for node in nodes:
        node.destroy_node()
    rclpy.try_shutdown()


def report_refusal(error: Exception) -> None:
    """Print why something does not start, in one line on stderr."""
    # rcl appends where in its own sources an error arose.
    reason = str(error).split(", at /")[0]
    print(f"error: {' '.join(reason.split())}", file=sys.stderr)
