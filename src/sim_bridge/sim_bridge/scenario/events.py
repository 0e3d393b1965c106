# SPDX-License-Identifier: Apache-2.0
"""The events of a scenario: a class for each kind of entry, and its reader."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from sim_bridge.bullet.obstacles import SHAPES, Obstacle, ObstacleError
from sim_bridge.scenario.fields import ScenarioEntry, ScenarioError, refuse
from sim_bridge.scenario.trajectory import read_trajectory
from viability_bounds_pkg.pose_trajectory import PoseTrajectory

_ZERO = [0.0, 0.0, 0.0]
_UPRIGHT = [0.0, 0.0, 0.0, 1.0]


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
class TrajectoryGoal:
    """A trajectory of the end effector in the base frame that begins at `time`."""

    time: float
    trajectory: PoseTrajectory


@dataclass(frozen=True)
class WrenchGoal:
    """The desired wrench of the end effector on its environment from `time` on."""

    time: float
    force: tuple[float, ...]
    """N."""
    torque: tuple[float, ...]
    """N m."""
    frame: str
    """Frame whose axes it is given in; empty for the end effector's."""


@dataclass(frozen=True)
class Push:
    """An external wrench on a link, in world axes, from `time` on for `duration` seconds."""

    time: float
    duration: float
    link: str
    force: tuple[float, ...]
    """N."""
    torque: tuple[float, ...]
    """N m."""


@dataclass(frozen=True)
class AddObstacle:
    """An obstacle in the robot's world; the controller does not know of it."""

    time: float
    obstacle: Obstacle
    """Placed in the base frame."""


@dataclass(frozen=True)
class RemoveObstacle:
    """The removal of an obstacle."""

    time: float
    name: str


@dataclass(frozen=True)
class EnableTorque:
    """A call of the controller's ``enable_torque``: torque or position control."""

    time: float
    enable: bool


@dataclass(frozen=True)
class ParameterChange:
    """New values of a node's parameters."""

    time: float
    node: str
    values: Mapping[str, Any]


@dataclass(frozen=True)
class TriggerCall:
    """A call of a ``std_srvs/Trigger`` service."""

    time: float
    service: str


Goal = PoseGoal | PostureGoal | TrajectoryGoal | WrenchGoal
"""Sent to the controller before their time."""
WorldEvent = Push | AddObstacle | RemoveObstacle
"""Sent to the robot before their time."""
ServiceEvent = EnableTorque | ParameterChange | TriggerCall
"""Services that take effect at once, called at their time."""
Event = Goal | WorldEvent | ServiceEvent


def read_event(content: Any, where: str) -> Event:
    """Return the event that an entry of the file describes.

    Raises:
        ScenarioError: the entry is unknown, malformed or out of range.
    """
    kinds = set(content) - {"time"} if isinstance(content, dict) else set()
    if len(kinds) != 1 or "time" not in content or not kinds <= set(_KINDS):
        raise ScenarioError(f"{where} must have 'time' and one of {', '.join(_KINDS)}")
    kind = kinds.pop()
    time = ScenarioEntry(content, where).number("time", zero=True)
    return _KINDS[kind](time, content[kind], f"{where}.{kind}")


def _pose(time: float, content: Any, where: str) -> PoseGoal:
    entry = ScenarioEntry(content, where, ("position", "orientation"))
    return PoseGoal(time, entry.vector("position"), entry.quaternion("orientation"))


def _posture(time: float, content: Any, where: str) -> PostureGoal:
    entry = ScenarioEntry(content, where)
    return PostureGoal(time, {str(key): entry.number(key, negative=True) for key in entry.fields})


def _trajectory(time: float, content: Any, where: str) -> TrajectoryGoal:
    return TrajectoryGoal(time, read_trajectory(content, where))


def _wrench(time: float, content: Any, where: str) -> WrenchGoal:
    entry = ScenarioEntry(content, where, ("force", "torque", "frame"))
    frame = entry.fields.get("frame", "")
    if not isinstance(frame, str):
        raise entry.refuse("frame", "the name of a frame, or nothing")
    force, torque = (entry.vector(key, default=_ZERO) for key in ("force", "torque"))
    return WrenchGoal(time, force, torque, frame)


def _push(time: float, content: Any, where: str) -> Push:
    entry = ScenarioEntry(content, where, ("link", "duration", "force", "torque"))
    force, torque = (entry.vector(key, default=_ZERO) for key in ("force", "torque"))
    link, duration = entry.name("link", "the name of a link"), entry.number("duration")
    return Push(time, duration, link, force, torque)


def _obstacle(time: float, content: Any, where: str) -> AddObstacle:
    entry = ScenarioEntry(content, where, ("name", "shape", "size", "position", "orientation"))
    try:
        obstacle = Obstacle(
            entry.name("name", "a name"),
            entry.name("shape", f"one of {', '.join(SHAPES)}"),
            entry.vector("size"),
            entry.vector("position"),
            entry.quaternion("orientation", _UPRIGHT),
        )
    except ObstacleError as error:
        raise ScenarioError(f"{where}: {error}") from None
    return AddObstacle(time, obstacle)


def _remove_obstacle(time: float, content: Any, where: str) -> RemoveObstacle:
    return RemoveObstacle(time, ScenarioEntry(content, where, ("name",)).name("name", "a name"))


def _enable_torque(time: float, content: Any, where: str) -> EnableTorque:
    if not isinstance(content, bool):
        raise refuse(where, content, "true or false")
    return EnableTorque(time, content)


def _parameters(time: float, content: Any, where: str) -> ParameterChange:
    entry = ScenarioEntry(content, where, ("node", "values"))
    node, values = entry.name("node", "the name of a node"), entry.fields.get("values")
    if not isinstance(values, dict) or not values:
        raise entry.refuse("values", "parameters and their values")
    return ParameterChange(
        time, node, {str(k): _parameter(v, f"{where}.values.{k}") for k, v in values.items()}
    )


def _parameter(value: Any, where: str) -> Any:
    """Return a valid value of a ROS parameter; a list of numbers as one of floats."""
    if isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, list) and value:
        if all(isinstance(item, int | float) and not isinstance(item, bool) for item in value):
            return [float(item) for item in value]
        if all(isinstance(item, str) for item in value):
            return value
    raise refuse(where, value, "true, false, a number, a string, or a list of numbers or strings")


def _call(time: float, content: Any, where: str) -> TriggerCall:
    entry = ScenarioEntry(content, where, ("service", "type"))
    if entry.fields.get("type", "trigger") != "trigger":
        raise entry.refuse("type", "trigger")
    return TriggerCall(time, entry.name("service", "the name of a service"))


_KINDS: dict[str, Callable[[float, Any, str], Event]] = {
    "pose": _pose,
    "posture": _posture,
    "trajectory": _trajectory,
    "wrench": _wrench,
    "push": _push,
    "obstacle": _obstacle,
    "remove_obstacle": _remove_obstacle,
    "enable_torque": _enable_torque,
    "parameters": _parameters,
    "call": _call,
}
