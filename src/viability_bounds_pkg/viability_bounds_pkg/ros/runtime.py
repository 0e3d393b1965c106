# SPDX-License-Identifier: Apache-2.0
"""What every node here needs to run: quality of service, an executor, a main()."""

from __future__ import annotations

import gc
import signal
import sys
from collections.abc import Callable

import rclpy
from builtin_interfaces.msg import Time
from numba.core.event import TimingListener, install_listener
from rclpy.context import Context
from rclpy.executors import Executor, ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future

from viability_bounds_pkg.exceptions import SettingError
from viability_bounds_pkg.robot_description import RobotDescriptionError

try:
    from rclpy.experimental import EventsExecutor
except ImportError:  # early Jazzy releases
    EventsExecutor = None

CONTROL_QOS = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Streams of states, bounds and commands: the newest wins, nothing is sent again."""

GOAL_QOS = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)
"""Goals: each one arrives, also when several are sent at once for later."""

LATCHED_QOS = QoSProfile(
    depth=1,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)
"""Sent once, received also by subscribers that come later: robot_description."""

_SIGNAL_CHECK_PERIOD = 0.2

_LEAVE_TIMEOUT = 5
"""How long a node may take to leave the graph, s."""


def make_executor(context: Context | None = None) -> Executor:
    """Return the fastest executor that this release of rclpy has.

    The events executor relays a message about ten times faster than the single-threaded one,
    which early Jazzy releases are left with.
    """
    if EventsExecutor is not None:
        return EventsExecutor(context=context)
    return SingleThreadedExecutor(context=context)


def spin(executor: Executor, context: Context | None = None) -> None:
    """Run callbacks until the context is shut down or SIGINT or SIGTERM comes.

    ``EventsExecutor.spin()`` of rclpy 7.1 runs no callback, and a wait without time-out does
    not see signals, so this waits in turns on a future that is never set. A signal lets the
    callback that it interrupts end: it may be about to publish. Call it from the main thread.
    """
    signals: list[int] = []
    for each in (signal.SIGINT, signal.SIGTERM):
        signal.signal(each, lambda number, _: signals.append(number))
    never: Future = Future()
    while rclpy.ok(context=context) and not signals:
        executor.spin_until_future_complete(never, timeout_sec=_SIGNAL_CHECK_PERIOD)


def run(make_node: Callable[[], Node], args: list[str] | None = None) -> int:
    """Start the node that `make_node` returns, run it until it is told to stop.

    Returns:
        The exit code: 0 after SIGINT, SIGTERM or shutdown; 1 when the node cannot start, after one
        line on stderr that says why.
    """
    try:
        # Its own handlers would shut down the context in the middle of a callback.
        rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
    except Exception as error:  # rclpy's own classes differ between releases
        report_refusal(error)
        return 1
    node = None
    try:
        compiling = TimingListener()
        with install_listener("numba:compile", compiling):
            node = make_node()
        if compiling.done:
            node.get_logger().warning(
                f"compiling took {compiling.duration:.1f} s of the start, which scripts/setup.sh "
                "does ahead: no compiled code of these sources was kept"
            )
        executor = make_executor()
        if EventsExecutor is None:
            node.get_logger().warning(
                "rclpy has no EventsExecutor; the single-threaded one adds about 2 ms a cycle"
            )
        executor.add_node(node)
        # What exists by now lives until the end: the collector need not visit it in the control
        # loop.
        gc.collect()
        gc.freeze()
        spin(executor)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except (SettingError, RobotDescriptionError) as error:
        report_refusal(error)
        return 1
    finally:
        leave(node)
        gc.unfreeze()
    return 0


def leave(node: Node | None) -> None:
    """Destroy a node and shut ROS down at the end of a process; call it from the main thread.

    When another process leaves at the same moment, Fast DDS 2.14 may wait for ever inside a call,
    so that no Python code runs any more. So the system ends the process if this takes too long.
    """
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.alarm(_LEAVE_TIMEOUT)
    if node is not None:
        node.destroy_node()
    rclpy.try_shutdown()
    signal.alarm(0)


def report_refusal(error: Exception) -> None:
    """Print why something does not start, in one line on stderr."""
    # rcl appends where in its own sources an error arose.
    reason = str(error).split(", at /")[0]
    print(f"error: {' '.join(reason.split())}", file=sys.stderr)


def stamp_to_ns(stamp: Time) -> int:
    """Return a ``builtin_interfaces/Time`` in nanoseconds."""
    return stamp.sec * 1_000_000_000 + stamp.nanosec


def set_stamp(stamp: Time, nanoseconds: int) -> None:
    """Write `nanoseconds` into a ``builtin_interfaces/Time``."""
    stamp.sec, stamp.nanosec = divmod(nanoseconds, 1_000_000_000)
