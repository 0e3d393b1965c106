"""The events of a scenario: a class for each kind of entry, and its reader."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from sim_bridge.bullet.obstacles import SHAPES, Obstacle, ObstacleError
from sim_bridge.scenario.fields import (
    Fields,
    ScenarioError,
    name,
    number,
    only,
    quaternion,
    refuse,
    vector,
)
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


def read_event(entry: Any, where: str) -> Event:
    """Return the event that an entry of the file describes.

    Raises:
        ScenarioError: the entry is unknown, malformed or out of range.
    """
    if not isinstance(entry, dict) or len(entry) != 2 or "time" not in entry:
        raise ScenarioError(f"{where} must have 'time' and one of {', '.join(_KINDS)}")
    kind = next(key for key in entry if key != "time")
    if kind not in _KINDS:
        raise ScenarioError(f"{where} must have 'time' and one of {', '.join(_KINDS)}")
    time = number(entry["time"], f"{where}.time", zero=True)
    content, where = entry[kind], f"{where}.{kind}"
    if kind != "enable_torque" and not isinstance(content, dict):
        raise refuse(where, content, "fields and their values")
    return _KINDS[kind](time, content, where)


def _pose(time: float, fields: Fields, where: str) -> PoseGoal:
    only(fields, ("position", "orientation"), where)
    return PoseGoal(
        time,
        vector(fields.get("position"), 3, f"{where}.position"),
        quaternion(fields.get("orientation"), f"{where}.orientation"),
    )


def _posture(time: float, fields: Fields, where: str) -> PostureGoal:
    return PostureGoal(
        time, {str(k): number(v, f"{where}.{k}", negative=True) for k, v in fields.items()}
    )


def _trajectory(time: float, fields: Fields, where: str) -> TrajectoryGoal:
    return TrajectoryGoal(time, read_trajectory(fields, where))


def _wrench(time: float, fields: Fields, where: str) -> WrenchGoal:
    only(fields, ("force", "torque", "frame"), where)
    frame = fields.get("frame", "")
    if not isinstance(frame, str):
        raise refuse(f"{where}.frame", frame, "the name of a frame, or nothing")
    return WrenchGoal(time, *_force_and_torque(fields, where), frame)


def _push(time: float, fields: Fields, where: str) -> Push:
    only(fields, ("link", "duration", "force", "torque"), where)
    link = name(fields.get("link"), f"{where}.link", "the name of a link")
    duration = number(fields.get("duration"), f"{where}.duration")
    return Push(time, duration, link, *_force_and_torque(fields, where))


def _force_and_torque(fields: Fields, where: str) -> tuple[tuple[float, ...], tuple[float, ...]]:
    return (
        vector(fields.get("force", _ZERO), 3, f"{where}.force"),
        vector(fields.get("torque", _ZERO), 3, f"{where}.torque"),
    )


def _obstacle(time: float, fields: Fields, where: str) -> AddObstacle:
    only(fields, ("name", "shape", "size", "position", "orientation"), where)
    obstacle = (
        name(fields.get("name"), f"{where}.name", "a name"),
        name(fields.get("shape"), f"{where}.shape", f"one of {', '.join(SHAPES)}"),
        vector(fields.get("size"), 3, f"{where}.size"),
        vector(fields.get("position"), 3, f"{where}.position"),
        quaternion(fields.get("orientation", _UPRIGHT), f"{where}.orientation"),
    )
    try:
        return AddObstacle(time, Obstacle(*obstacle))
    except ObstacleError as error:
        raise ScenarioError(f"{where}: {error}") from None


def _remove_obstacle(time: float, fields: Fields, where: str) -> RemoveObstacle:
    only(fields, ("name",), where)
    return RemoveObstacle(time, name(fields.get("name"), f"{where}.name", "a name"))


def _enable_torque(time: float, value: Any, where: str) -> EnableTorque:
    if not isinstance(value, bool):
        raise refuse(where, value, "true or false")
    return EnableTorque(time, value)


def _parameters(time: float, fields: Fields, where: str) -> ParameterChange:
    only(fields, ("node", "values"), where)
    node = name(fields.get("node"), f"{where}.node", "the name of a node")
    values = fields.get("values")
    if not isinstance(values, dict) or not values:
        raise refuse(f"{where}.values", values, "parameters and their values")
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


def _call(time: float, fields: Fields, where: str) -> TriggerCall:
    only(fields, ("service", "type"), where)
    if fields.get("type", "trigger") != "trigger":
        raise refuse(f"{where}.type", fields["type"], "trigger")
    return TriggerCall(
        time, name(fields.get("service"), f"{where}.service", "the name of a service")
    )


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
