# SPDX-License-Identifier: Apache-2.0
"""Quality of service, executor, timers, stamps, and settings of DDS."""

from __future__ import annotations

from collections.abc import Callable, MutableMapping
from pathlib import Path

from builtin_interfaces.msg import Time
from rclpy.clock import Clock, ClockType
from rclpy.context import Context
from rclpy.executors import Executor, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.timer import Timer

try:
    from rclpy.experimental import EventsExecutor as EventsExecutor
except ImportError:  # early Jazzy releases
    EventsExecutor = None

CONTROL_QOS = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Streams of states, bounds and commands: the newest wins, nothing is sent again."""

GOAL_QOS = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)
"""Goals: each one arrives, also when several are sent at once for later."""

STATUS_QOS = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)
"""What tools show: also heard where a subscription is reliable, as those of RViz are."""

NEWEST_QOS = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE)
"""Streams as they are published, and their slow copies: the newest is enough, a publisher never
waits, and whoever subscribes reliably hears them, too."""

LATCHED_QOS = QoSProfile(
    depth=1,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)
"""Sent once, received also by subscribers that come later: robot_description."""

_PROFILES = "FASTRTPS_DEFAULT_PROFILES_FILE"
_WITH_UDP = "", "DEFAULT", "UDPv4"
"""Built-in transports with which messages can come by UDP."""


def settle_dds(environment: MutableMapping[str, str]) -> None:
    """Choose settings of Fast DDS by which nodes that start again are heard soon, `fastdds.xml`.

    Users who have settings of their own, or other transports, keep them. Call it before the first
    node of a process is made.

    Args:
        environment: of the process; its children inherit it.
    """
    own = Path("DEFAULT_FASTRTPS_PROFILES.xml")  # in the working directory, where it looks, too
    transports = environment.get("FASTDDS_BUILTIN_TRANSPORTS", "")
    if environment.get(_PROFILES) or own.exists() or transports not in _WITH_UDP:
        return
    environment[_PROFILES] = str(Path(__file__).with_name("fastdds.xml"))


def make_executor(context: Context | None = None) -> Executor:
    """Return the fastest executor that this release of rclpy has.

    The events executor relays a message about ten times faster than the single-threaded one,
    which early Jazzy releases are left with.
    """
    if EventsExecutor is not None:
        return EventsExecutor(context=context)
    return SingleThreadedExecutor(context=context)


def steady_timer(node: Node, period: float, callback: Callable[[], None]) -> Timer:
    """Return a timer, period in s, on the steady clock: it also runs when ``/clock`` stops."""
    return node.create_timer(period, callback, clock=Clock(clock_type=ClockType.STEADY_TIME))


def is_subscribed(node: Node, topic: str, subscriber: str) -> bool:
    """Return whether the node of a name subscribes to a topic; others may, as viewers do."""
    infos = node.get_subscriptions_info_by_topic(topic)
    return any(each.node_name == subscriber for each in infos)


def stamp_to_ns(stamp: Time) -> int:
    """Return a ``builtin_interfaces/Time`` in nanoseconds."""
    return stamp.sec * 1_000_000_000 + stamp.nanosec


def set_stamp(stamp: Time, nanoseconds: int) -> None:
    """Write `nanoseconds` into a ``builtin_interfaces/Time``."""
    stamp.sec, stamp.nanosec = divmod(nanoseconds, 1_000_000_000)
