# SPDX-License-Identifier: Apache-2.0
"""A scenario: goals, pushes, obstacles and service calls over time, read from YAML."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from sim_bridge.scenario.events import (
    AddObstacle,
    Event,
    Goal,
    PostureGoal,
    Push,
    RemoveObstacle,
    WrenchGoal,
    read_event,
)
from sim_bridge.scenario.fields import ScenarioError, positive, read_fields, refuse
from viability_bounds_pkg.exceptions import SettingError, did_you_mean
from viability_bounds_pkg.parameter import text, timeout
from viability_bounds_pkg.parameter_files import YamlError, read_yaml
from viability_bounds_pkg.robot.configuration import LimitedRobotConfiguration, TaskFrames


@dataclass(frozen=True)
class Scenario:
    """Events over time; all times in seconds of robot time from the start.

    Attributes:
        duration: its end.
        events: in order of time.
    """

    duration: float
    events: tuple[Event, ...]


@dataclass(frozen=True, eq=False, kw_only=True)
class ScenarioConfiguration(TaskFrames, LimitedRobotConfiguration):
    """Parameters of the scenario node: a scenario and the arm that plays it.

    Attributes:
        urdf: text of the URDF.
        plan: the scenario.
    """

    robot_name: str = text("name of the robot in the report", default="robot")
    scenario: str = text("YAML file of the scenario")
    robot_node: str = text(
        "node that simulates the robot, and reports whether it kept its limits",
        default="bullet_node",
    )
    ready_timeout: float = timeout("how long the other nodes may take to start, s", default=180.0)
    urdf: str = field(init=False)
    plan: Scenario = field(init=False)

    def __post_init__(self) -> None:
        """Read URDF and scenario, and check that they fit."""
        super().__post_init__()
        try:
            plan = load_scenario(self.scenario)
        except ScenarioError as error:
            reason = str(error).removeprefix(f"scenario {self.scenario}").lstrip(":, ")
            raise SettingError("scenario", self.scenario, f"a scenario ({reason})") from error
        object.__setattr__(self, "plan", plan)
        object.__setattr__(self, "urdf", self.read_urdf())
        root = ElementTree.fromstring(self.urdf)
        links = [link.get("name", "") for link in root.iter("link")]
        for event in plan.events:
            if allowed := self._allowed_instead(event, links):
                raise SettingError("scenario", self.scenario, allowed)

    def _allowed_instead(self, event: Event, links: list[str]) -> str:
        """Return what is allowed where an event does not fit the arm; nothing where it does."""
        at = f"at {event.time:g} s there is"
        if isinstance(event, PostureGoal):
            if missing := [name for name in self.joints if name not in event.positions]:
                return f"postures of all 'joints'; {at} none of {', '.join(missing)}"
            if others := [name for name in event.positions if name not in self.joints]:
                return f"postures of 'joints'; {at} one of {', '.join(others)}"
        frames = self.end_effectors[0], self.base_frame
        if isinstance(event, WrenchGoal) and event.frame not in ("", *frames):
            return f"wrenches in the axes of {' or '.join(frames)}; {at} one in {event.frame!r}"
        if isinstance(event, Push) and event.link not in links:
            hint = did_you_mean(event.link, links)
            return f"pushes of links of the URDF; {at} one of '{event.link}'{hint}"
        return ""


def load_scenario(path: str | Path) -> Scenario:
    """Read a scenario; ``docs/guides/simulation.md`` describes the file.

    Raises:
        ScenarioError: the file is missing, or an entry in it is unknown, malformed or out of
            range; the message names file, entry and what is allowed.
    """
    try:
        content = read_yaml(path)
    except YamlError as error:
        raise ScenarioError(f"scenario {error}") from error
    try:
        fields = read_fields(content, "", {"duration": positive, "events": _events}, ("events",))
        duration, events = fields["duration"], fields.get("events", [])
        for i, event in enumerate(events):
            if event.time >= duration:
                raise refuse(f"events[{i}].time", event.time, f"less than {duration:g}, the end")
        events.sort(key=lambda event: event.time)
        _check_goals(events)
        _check_pushes(events)
        _check_obstacles(events)
    except ScenarioError as error:
        raise ScenarioError(f"scenario {path}: {error}") from None
    return Scenario(duration, tuple(events))


def _events(content: Any, where: str) -> list[Event]:
    if not isinstance(content, list | None):
        raise refuse(where, content, "a list")
    return [read_event(entry, f"{where}[{i}]") for i, entry in enumerate(content or ())]


def _check_goals(events: list[Event]) -> None:
    """Refuse goals of one kind at one time: the last one alone would count."""
    seen: set[tuple[type, float]] = set()
    for goal in (event for event in events if isinstance(event, Goal)):
        kind = type(goal), goal.time
        if kind in seen:
            what = kind[0].__name__.removesuffix("Goal").lower()
            raise ScenarioError(f"there are two of {what} at {goal.time:g} s; allowed: one")
        seen.add(kind)


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
