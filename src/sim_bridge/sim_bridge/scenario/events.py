"""What may happen in a scenario: one class for each kind of entry, and how it is read."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from sim_bridge.bullet.obstacles import SHAPES, Obstacle, ObstacleError
from sim_bridge.scenario.fields import (
    ScenarioError,
    name,
    number,
    only,
    quaternion,
    refuse,
    vector,
)
from sim_bridge.scenario.pose_path import PathPoint
from sim_bridge.scenario.trajectory import read_points

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
    """A path of the end effector in the base frame that begins at `time`."""

    time: float
    points: tuple[PathPoint, ...]


@dataclass(frozen=True)
class WrenchGoal:
    """A wrench that the end effector is to exert from `time` on."""

    time: float
    force: tuple[float, ...]
    """N."""
    torque: tuple[float, ...]
    """N m."""
    frame: str
    """In whose axes; empty for the end effector's."""


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
class AddObstacle:
    """A thing in the robot's world that the controller is not told of."""

    time: float
    obstacle: Obstacle
    """Placed in the base frame."""


@dataclass(frozen=True)
class RemoveObstacle:
    """The end of an obstacle."""

    time: float
    name: str


@dataclass(frozen=True)
class EnableTorque:
    """The controller's service ``enable_torque``: torque control, or position control."""

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
"""What the controller is sent ahead."""
WorldEvent = Push | AddObstacle | RemoveObstacle
"""What the robot is sent ahead."""
ServiceEvent = EnableTorque | ParameterChange | TriggerCall
"""What takes effect at once, and is asked for when its time has come."""
Event = Goal | WorldEvent | ServiceEvent


def read_event(entry: Any, where: str) -> Event:
    """Return the event that an entry of the file stands for.

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


def _pose(time: float, fields: dict, where: str) -> PoseGoal:
    only(fields, ("position", "orientation"), where)
    return PoseGoal(
        time,
        vector(fields.get("position"), 3, f"{where}.position"),
        quaternion(fields.get("orientation"), f"{where}.orientation"),
    )


def _posture(time: float, fields: dict, where: str) -> PostureGoal:
    return PostureGoal(
        time, {str(k): number(v, f"{where}.{k}", negative=True) for k, v in fields.items()}
    )


def _trajectory(time: float, fields: dict, where: str) -> TrajectoryGoal:
    return TrajectoryGoal(time, read_points(fields, where))


def _wrench(time: float, fields: dict, where: str) -> WrenchGoal:
    only(fields, ("force", "torque", "frame"), where)
    frame = fields.get("frame", "")
    if not isinstance(frame, str):
        raise refuse(f"{where}.frame", frame, "the name of a frame, or nothing")
    return WrenchGoal(time, *_force_and_torque(fields, where), frame)


def _push(time: float, fields: dict, where: str) -> Push:
    only(fields, ("link", "duration", "force", "torque"), where)
    link = name(fields.get("link"), f"{where}.link", "the name of a link")
    duration = number(fields.get("duration"), f"{where}.duration")
    return Push(time, duration, link, *_force_and_torque(fields, where))


def _force_and_torque(fields: dict, where: str) -> tuple[tuple[float, ...], tuple[float, ...]]:
    return (
        vector(fields.get("force", _ZERO), 3, f"{where}.force"),
        vector(fields.get("torque", _ZERO), 3, f"{where}.torque"),
    )


def _obstacle(time: float, fields: dict, where: str) -> AddObstacle:
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


def _remove_obstacle(time: float, fields: dict, where: str) -> RemoveObstacle:
    only(fields, ("name",), where)
    return RemoveObstacle(time, name(fields.get("name"), f"{where}.name", "a name"))


def _enable_torque(time: float, value: Any, where: str) -> EnableTorque:
    if not isinstance(value, bool):
        raise refuse(where, value, "true or false")
    return EnableTorque(time, value)


def _parameters(time: float, fields: dict, where: str) -> ParameterChange:
    only(fields, ("node", "values"), where)
    node = name(fields.get("node"), f"{where}.node", "the name of a node")
    values = fields.get("values")
    if not isinstance(values, dict) or not values:
        raise refuse(f"{where}.values", values, "parameters and their values")
    return ParameterChange(
        time, node, {str(k): _parameter(v, f"{where}.values.{k}") for k, v in values.items()}
    )


def _parameter(value: Any, where: str) -> Any:
    """Return a value that a ROS parameter can have; a list of numbers as one of floats."""
    if isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, list) and value:
        if all(isinstance(item, int | float) and not isinstance(item, bool) for item in value):
            return [float(item) for item in value]
        if all(isinstance(item, str) for item in value):
            return value
    raise refuse(where, value, "true, false, a number, a string, or a list of numbers or strings")


def _call(time: float, fields: dict, where: str) -> TriggerCall:
    only(fields, ("service", "type"), where)
    if fields.get("type", "trigger") != "trigger":
        raise refuse(f"{where}.type", fields["type"], "trigger")
    return TriggerCall(
        time, name(fields.get("service"), f"{where}.service", "the name of a service")
    )


_KINDS = {
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
