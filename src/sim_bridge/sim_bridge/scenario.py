"""A scenario: a timeline of goals and pushes, read from YAML and checked."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml


class ScenarioError(ValueError):
    """A scenario file that cannot be played."""


@dataclass(frozen=True)
class PoseGoal:
    """An end-effector pose in the base frame from `time` on."""

    time: float
    position: tuple[float, ...]
    """x, y, z, m."""
    orientation: tuple[float, ...]
    """Unit quaternion x, y, z, w."""


@dataclass(frozen=True)
class PostureGoal:
    """Joint positions, rad by name, from `time` on."""

    time: float
    positions: Mapping[str, float]


@dataclass(frozen=True)
class Push:
    """A wrench on a link, world-aligned, from `time` on for `duration` seconds."""

    time: float
    duration: float
    link: str
    force: tuple[float, ...]
    """N."""
    torque: tuple[float, ...]
    """N m."""


@dataclass(frozen=True)
class Scenario:
    """What happens when; all times in seconds of robot time from the start.

    Attributes:
        duration: when it is over.
        events: in order of time.
    """

    duration: float
    events: tuple[PoseGoal | PostureGoal | Push, ...]


def load_scenario(path: str | Path) -> Scenario:
    """Read a scenario.

    Raises:
        ScenarioError: the file is missing, or an entry in it is unknown, malformed or out of
            range; the message names file, entry and what is allowed.
    """
    try:
        content = yaml.safe_load(Path(path).read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise ScenarioError(f"scenario {path}: {error}") from error
    if not isinstance(content, dict) or set(content) - {"duration", "events"}:
        raise ScenarioError(f"scenario {path}: has keys other than 'duration' and 'events'")
    try:
        duration = _number(content.get("duration"), "duration")
        entries = content.get("events") or []
        if not isinstance(entries, list):
            raise ScenarioError(f"events is {entries!r}; allowed: a list")
        events = [_event(entry, f"events[{i}]") for i, entry in enumerate(entries)]
    except ScenarioError as error:
        raise ScenarioError(f"scenario {path}: {error}") from None
    return Scenario(duration, tuple(sorted(events, key=lambda event: event.time)))


def _event(entry: Any, where: str) -> PoseGoal | PostureGoal | Push:
    kinds = {"pose": _pose, "posture": _posture, "push": _push}
    if not isinstance(entry, dict) or len(entry) != 2 or "time" not in entry:
        raise ScenarioError(f"{where} must have 'time' and one of {', '.join(kinds)}")
    kind = next(key for key in entry if key != "time")
    if kind not in kinds or not isinstance(entry[kind], dict):
        raise ScenarioError(f"{where} must have 'time' and one of {', '.join(kinds)}")
    time = _number(entry["time"], f"{where}.time", zero=True)
    return kinds[kind](time, entry[kind], f"{where}.{kind}")


def _pose(time: float, fields: dict, where: str) -> PoseGoal:
    _only(fields, {"position", "orientation"}, where)
    orientation = _vector(fields.get("orientation"), 4, f"{where}.orientation")
    norm = math.hypot(*orientation)
    if abs(norm - 1.0) > 1e-3:
        raise ScenarioError(f"{where}.orientation has norm {norm:g}; allowed: 1 within 0.001")
    return PoseGoal(time, _vector(fields.get("position"), 3, f"{where}.position"), orientation)


def _posture(time: float, fields: dict, where: str) -> PostureGoal:
    return PostureGoal(
        time, {str(k): _number(v, f"{where}.{k}", negative=True) for k, v in fields.items()}
    )


def _push(time: float, fields: dict, where: str) -> Push:
    _only(fields, {"link", "duration", "force", "torque"}, where)
    link = fields.get("link")
    if not isinstance(link, str) or not link:
        raise ScenarioError(f"{where}.link is {link!r}; allowed: the name of a link")
    zero = [0.0, 0.0, 0.0]
    return Push(
        time,
        _number(fields.get("duration"), f"{where}.duration"),
        link,
        _vector(fields.get("force", zero), 3, f"{where}.force"),
        _vector(fields.get("torque", zero), 3, f"{where}.torque"),
    )


def _only(fields: dict, allowed: set[str], where: str) -> None:
    unknown = set(fields) - allowed
    if unknown:
        allowed_names = ", ".join(sorted(allowed))
        raise ScenarioError(f"{where} has {', '.join(sorted(unknown))}; allowed: {allowed_names}")


def _number(value: Any, where: str, *, zero: bool = False, negative: bool = False) -> float:
    sign = "" if negative else " >= 0" if zero else " > 0"
    if (
        not _is_finite(value)
        or (value < 0 and not negative)
        or (value == 0 and not (zero or negative))
    ):
        raise ScenarioError(f"{where} is {value!r}; allowed: a finite number{sign}")
    return float(value)


def _vector(value: Any, size: int, where: str) -> tuple[float, ...]:
    if not isinstance(value, Sequence) or isinstance(value, str) or len(value) != size:
        raise ScenarioError(f"{where} is {value!r}; allowed: {size} numbers")
    if not all(map(_is_finite, value)):
        raise ScenarioError(f"{where} is {value!r}; allowed: {size} finite numbers")
    return tuple(map(float, value))


def _is_finite(value: Any) -> bool:
    """Return whether `value` is a number that a float can hold."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:
        return False
