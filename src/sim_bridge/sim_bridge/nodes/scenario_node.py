# SPDX-License-Identifier: Apache-2.0
"""The scenario node: plays a scenario over topics and services, and records the run."""

from __future__ import annotations

import math
from collections import deque
from enum import Enum, auto
from typing import Any

import numpy as np
from rclpy.clock import Clock, ClockType
from rclpy.node import Node

from sim_bridge.nodes.run_listener import RunListener
from sim_bridge.nodes.scenario_messages import (
    RESET,
    change_parameters,
    pause,
    to_controller,
    to_robot,
    to_service,
)
from sim_bridge.nodes.scenario_sender import ScenarioRefused, ScheduledPublisher, ServiceCaller
from sim_bridge.scenario.events import ServiceEvent
from sim_bridge.scenario.recording import RecordedRun
from sim_bridge.scenario.scenario import ScenarioConfiguration
from viability_bounds_pkg.exceptions import SettingError
from viability_bounds_pkg.ros.parameters import NodeParameters

_POLL_PERIOD = 0.02
_REFUSAL_COUNTS: dict[str, tuple[str, str | tuple[str, ...]]] = {
    "controller_node": ("goals_refused", "target_"),
    "bullet_node": ("commands_refused", ("external_wrench", "obstacles")),
}
"""By node, the diagnostics key that counts refusals by topic, and the topics of a scenario."""


class Phase(Enum):
    """Progress of a scenario."""

    GETTING_READY = auto()
    """Waits for a paused robot, the other nodes, their subscriptions and services."""
    RESETTING = auto()
    """The robot is reset; the first command for that state has not come."""
    LOADING = auto()
    """Scheduled messages are sent; not all have been reported as received."""
    PLAYING = auto()
    STOPPING = auto()
    """A message or call was refused; the robot is being paused."""
    DONE = auto()


class ScenarioNode(Node):
    """Resets a paused robot, plays a scenario on it, and records the run.

    Goals, pushes and obstacles are sent before their time with the stamps at which they take
    effect. In lockstep the robot is paused where a service must be called, until it has answered;
    so a run in lockstep is the same each time.

    Attributes:
        phase: progress of the scenario.
        failure: why it ended early; None if it did not.
        listener: the recorded messages and diagnostics of the other nodes.
    """

    def __init__(self, **node_arguments: Any) -> None:
        super().__init__("scenario_node", **node_arguments)
        try:
            config = NodeParameters(self, ScenarioConfiguration).configuration
        except SettingError:
            self.destroy_node()
            raise
        self.config = config
        self.phase = Phase.GETTING_READY
        self.failure: ScenarioRefused | None = None
        self.listener = RunListener(self, config.joints)
        self._first, self._period = 0, 1
        self._refused: dict[str, list[str]] = {}  # when the scenario's messages begin
        self._refusal: ScenarioRefused | None = None
        self._halt = self._end = 0  # periods from the start
        frames = config.base_frame, config.end_effector_frame
        self._goals = ScheduledPublisher(self, to_controller(config.plan, *frames))
        self._world = ScheduledPublisher(self, to_robot(config.plan, config.base_frame))
        self._due = deque(e for e in config.plan.events if isinstance(e, ServiceEvent))
        own = RESET, pause(False), change_parameters("bullet_node", {})
        self._caller = ServiceCaller(self, [*own, *map(to_service, self._due)])
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(_POLL_PERIOD, self._proceed, clock=steady)

    @property
    def done(self) -> bool:
        """Whether the scenario has ended."""
        return self.phase is Phase.DONE

    @property
    def robot(self) -> dict[str, str]:
        """The robot's last diagnostics, by key."""
        return self.listener.diagnostics["bullet_node"]

    def recorded_run(self) -> RecordedRun:
        """Return the recording since the robot began to move."""
        return self.listener.recorder.run(self._first)

    # Course of the scenario

    def _proceed(self) -> None:
        try:
            if self.phase in (Phase.LOADING, Phase.PLAYING):
                self._check_refusals()
            if self.phase is Phase.GETTING_READY and not self.awaited():
                self.phase, self._first = Phase.RESETTING, self.listener.stamp
                self._caller.add("", RESET)
            elif self.phase is Phase.RESETTING and self._caller.proceed() and self._is_reset():
                self.phase = Phase.LOADING
                self._plan()
            elif self.phase is Phase.LOADING and self._load():
                self.phase = Phase.PLAYING
                self._resume()
            elif self.phase is Phase.PLAYING and self._caller.proceed():
                self._play()
            elif self.phase is Phase.STOPPING and self._caller.proceed():
                self.failure, self.phase = self._refusal, Phase.DONE
        except ScenarioRefused as error:
            self._refusal, self.phase = error, Phase.STOPPING
            self._caller.drop()
            self._caller.add("", pause(True))

    def awaited(self) -> list[str]:
        """Return what is missing before the scenario can proceed."""
        if self.phase is Phase.LOADING:
            return ["report that goals, pushes and obstacles were received"]
        if self.phase is not Phase.GETTING_READY:
            return self._caller.awaited
        paused = self.robot.get("paused") == "True"
        topics = self._goals.without_subscriber() + self._world.without_subscriber()
        return (
            ([] if paused else ["a paused robot"])
            + ([] if self.listener.answered >= 0 else ["joint commands"])
            + [f"service {service}" for service in self._caller.missing()]
            + [f"a subscriber of {topic}" for topic in topics]
        )

    def _is_reset(self) -> bool:
        """Return whether there is a command for the state published by the reset."""
        return self.listener.answered == self.listener.stamp > self._first

    def _plan(self) -> None:
        # Resuming begins a new period: the first state in motion is the next.
        self._period = round(1e9 * float(self.robot["period_s"]))
        self._first = self.listener.stamp + self._period
        self._end = round(1e9 * self.config.plan.duration / self._period)

    def _load(self) -> bool:
        """Send scheduled messages; return whether all were received."""
        goals = self.listener.diagnostics["controller_node"].get("goals_pending", 0)
        loaded = self._goals.proceed(self._first, int(goals))
        changes = int(self.robot["world_changes_pending"])
        return self._world.proceed(self._first, changes) and loaded

    def _check_refusals(self) -> None:
        for node, (key, topics) in _REFUSAL_COUNTS.items():
            counts = self.listener.diagnostics[node].get(key, "").split("; ")
            refused = [count for count in counts if count.startswith(topics)]
            if refused != self._refused.setdefault(node, refused):
                raise ScenarioRefused(f"refused by {node}: {' '.join(refused)}")

    def _play(self) -> None:
        # In lockstep the robot pauses where a service is due; its report after the pause at the
        # end is final.
        over = int(self.robot["stamp_ns"]) >= self._first + (self._halt - 1) * self._period
        if not over or self.robot["paused"] != "True":
            if self.robot["clock"] != "lockstep":
                self._call((self.listener.stamp - self._first) // self._period)
        elif self._halt == self._end:
            self.phase = Phase.DONE
        else:
            self._resume()

    def _resume(self) -> None:
        """Call the services that are due, then resume the robot until the next ones are."""
        now, self._halt = self._halt, self._end
        self._call(now)
        if self._due and self.robot["clock"] == "lockstep":
            self._halt = min(self._end, self._period_of(self._due[0]))
        left = 1e-9 * self._period * (self._halt - now)
        self._caller.add("", change_parameters("bullet_node", {"pause_after": left}))
        self._caller.add("", pause(False))
        self._caller.proceed()

    def _call(self, period: int) -> None:
        """Call the services that are due when a period, counted from the first, begins."""
        while self._due and self._period_of(self._due[0]) <= period:
            event = self._due.popleft()
            self._caller.add(f"at {event.time:g} s: ", to_service(event))

    def _period_of(self, event: ServiceEvent) -> int:
        """Return the first period that begins at or after the time of an event."""
        return math.ceil(1e9 * event.time / self._period - 1e-6)

    # Output

    def live_line(self) -> str:
        """Return the state of the run in one line."""
        q = self.listener.q
        if self.phase is Phase.GETTING_READY or q is None:
            return "waiting for the nodes"
        distance = np.minimum(q - self.config.position_min, self.config.position_max - q)
        nearest = int(np.argmin(distance))
        controller = self.listener.diagnostics["controller_node"]
        error = float(controller.get("position_error_m", "nan"))
        return (
            f"{max(0.0, (self.listener.stamp - self._first) * 1e-9):6.2f} s  "
            f"{controller.get('mode', '?'):<8}  "
            f"nearest limit {self.config.joints[nearest]} {distance[nearest]:+.4f} rad  "
            f"pose error {1e3 * error:7.2f} mm  "
            f"{float(self.robot.get('rate_hz', 'nan')):5.0f} Hz"
        )
