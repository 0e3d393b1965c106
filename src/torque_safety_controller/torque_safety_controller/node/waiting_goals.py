# SPDX-License-Identifier: Apache-2.0
"""Messages with goals: from one publisher only, kept until the time of their stamps."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

from torque_safety_controller.driving.trajectory import TrajectoryPassed
from torque_safety_controller.node.goal_messages import GoalRefused, check_stamp
from torque_safety_controller.node.periodic import StateStream
from viability_bounds_pkg.ros.arm_node import ArmNode
from viability_bounds_pkg.ros.refusals import RefusalLog
from viability_bounds_pkg.ros.runtime import stamp_to_ns
from viability_bounds_pkg.ros.topics import Topic

WAITING_MAX = 1000
"""So many goals may wait for their time."""


class _Waiting(NamedTuple):
    """A goal that waits for its time."""

    stamp: int
    """ns."""
    topic: Topic
    apply: Callable[[], None]
    """May raise `GoalRefused` or `TrajectoryPassed`."""


class WaitingGoals:
    """Goals that wait until they are due.

    A stamp of zero, or one that has passed, takes effect with the next control step; one ahead
    takes effect with the first state at or after it, which makes a plan of goals repeatable. One
    that is further ahead than `ahead_max` is refused: it is of another clock. Where several nodes
    publish a topic, what comes on it is refused.

    Args:
        node: listens and logs what is refused.
        states: tell the robot's time.
        ahead_max: how far stamps may be ahead of it, s.

    Attributes:
        refused: how many goals, and publishers of goals, were refused, by topic.
    """

    def __init__(self, node: ArmNode, states: StateStream, ahead_max: float) -> None:
        self._node, self._watch = node, node.publisher_watch
        self._states, self._ahead_max = states, ahead_max
        self.refused: Counter[str] = Counter()
        self._waiting: list[_Waiting] = []
        self._contested: set[str] = set()
        self._refusals = RefusalLog(node.get_logger().warning)

    def __len__(self) -> int:
        return len(self._waiting)

    @property
    def due(self) -> str:
        """Which goal is the next, and when, in words; empty if there is none."""
        if not self._waiting or (left := self._waiting[0].stamp - self._states.stamp) <= 0:
            return ""
        return f"{self._waiting[0].topic.name} due in {1e-9 * left:.1f} s"

    @property
    def contested(self) -> bool:
        """Whether goals were refused of nodes that still publish the same topic."""
        if self._contested:
            self._contested = {name for name in self._contested if not self._watch.admits(name)}
        return bool(self._contested)

    def listen(self, topic: Topic, callback: Callable[[Any], None]) -> None:
        """Subscribe to a topic of goals; `callback` gets those of a node that is alone with it.

        It may raise `GoalRefused`.
        """
        name = self._node.resolve_topic_name(topic.name)
        self._watch.add(name)

        def receive(message: Any) -> None:
            if self._watch.admits(name):
                try:
                    callback(message)
                except GoalRefused as error:
                    self.refuse(topic, error)
            elif name in self._contested:  # told already; more may come at any rate
                self.refused[topic.name] += 1
            else:
                self._contested.add(name)
                self.refuse(topic, f"several nodes publish '{name}'")

        topic.subscription(self._node, receive, partial(self.refuse, topic))

    def refuse(self, topic: Topic, reason: Exception | str) -> None:
        """Count and log a goal that cannot be followed, or a publisher that cannot be heard."""
        self.refused[topic.name] += 1
        self._refusals.tell(f"{topic.name} refused: {reason}")

    def add(self, topic: Topic, message: Any, apply: Callable[[], None]) -> None:
        """Call `apply` when the time in the header of `message` has come; see `_Waiting`."""
        stamp = stamp_to_ns(message.header.stamp)
        check_stamp(stamp, self._states.stamp, self._ahead_max)
        if len(self._waiting) >= WAITING_MAX:
            raise GoalRefused(f"{WAITING_MAX} goals wait for their time already")
        self._waiting.append(_Waiting(stamp, topic, apply))
        self._waiting.sort(key=lambda goal: goal.stamp)

    def apply_due(self, stamp: int) -> list[str]:
        """Apply the goals that are due at `stamp`, ns; return their topics."""
        due, waiting, ahead = [], self._waiting, self._ahead_max
        # It came before the first state, or the robot's time has begun anew.
        while waiting and 1e-9 * (waiting[-1].stamp - stamp) > ahead:
            goal = waiting.pop()
            self._try(goal.topic, partial(check_stamp, goal.stamp, stamp, ahead))
        while waiting and waiting[0].stamp <= stamp:
            goal = waiting.pop(0)
            self._try(goal.topic, goal.apply)
            due.append(goal.topic.name)
        return due

    def _try(self, topic: Topic, act: Callable[[], None]) -> None:
        try:
            act()
        except (GoalRefused, TrajectoryPassed) as error:
            self.refuse(topic, error)
