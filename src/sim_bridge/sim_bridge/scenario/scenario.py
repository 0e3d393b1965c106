# SPDX-License-Identifier: Apache-2.0
"""A scenario: goals, pushes, obstacles and service calls over time, read from YAML."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from sim_bridge.scenario.events import AddObstacle, Event, Push, RemoveObstacle, read_event
from sim_bridge.scenario.fields import ScenarioError, positive, read_fields, refuse
from sim_bridge.urdf.arm import ConfiguredArm


@dataclass(frozen=True)
class Scenario:
    """Events over time; all times in seconds of robot time from the start.

    Attributes:
        duration: its end.
        events: in order of time.
    """

    duration: float
    events: tuple[Event, ...]


@dataclass(frozen=True)
class ScenarioConfiguration(ConfiguredArm):
    """A scenario and the arm that plays it.

    Attributes:
        name: of the robot.
        base_frame: of pose goals.
        end_effector_frame: frame that pose goals move.
        scenario: its events.
        ready_timeout: how long the other nodes may take to start or to answer, s.
    """

    name: str
    base_frame: str
    end_effector_frame: str
    scenario: Scenario
    ready_timeout: float


def load_scenario(path: str | Path) -> Scenario:
    """Read a scenario; ``docs/scenarios.md`` describes the file.

    Raises:
        ScenarioError: the file is missing, or an entry in it is unknown, malformed or out of
            range; the message names file, entry and what is allowed.
    """
    try:
        content = yaml.safe_load(Path(path).read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise ScenarioError(f"scenario {path}: {error}") from error
    try:
        fields = read_fields(content, "", {"duration": positive, "events": _events}, ("events",))
        duration, events = fields["duration"], fields.get("events", [])
        for i, event in enumerate(events):
            if event.time >= duration:
                raise refuse(f"events[{i}].time", event.time, f"less than {duration:g}, the end")
        events.sort(key=lambda event: event.time)
        _check_pushes(events)
        _check_obstacles(events)
    except ScenarioError as error:
        raise ScenarioError(f"scenario {path}: {error}") from None
    return Scenario(duration, tuple(events))


def _events(content: Any, where: str) -> list[Event]:
    if not isinstance(content, list | None):
        raise refuse(where, content, "a list")
    return [read_event(entry, f"{where}[{i}]") for i, entry in enumerate(content or ())]


def _check_pushes(events: list[Event]) -> None:
    """Refuse pushes of the same link that overlap: the robot keeps one for each link."""
    until: dict[str, float] = {}
    for push in (event for event in events if isinstance(event, Push)):
        if push.time < until.get(push.link, 0.0) - 1e-9:
            raise ScenarioError(
                f"the push of {push.link} at {push.time:g} s begins before the one before it ends "
                f"at {until[push.link]:g} s; allowed: one push of a link at a time"
            )
        until[push.link] = push.time + push.duration


def _check_obstacles(events: list[Event]) -> None:
    """Refuse to remove obstacles that do not exist."""
    present: set[str] = set()
    for event in events:
        if isinstance(event, AddObstacle):
            present.add(event.obstacle.name)
        elif isinstance(event, RemoveObstacle):
            if event.name not in present:
                known = ", ".join(sorted(present)) or "none"
                raise ScenarioError(
                    f"remove_obstacle at {event.time:g} s names {event.name!r}; there are: {known}"
                )
            present.remove(event.name)
