# SPDX-License-Identifier: Apache-2.0
"""The events of a scenario: a class for each kind of entry, and the fields of that entry."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from sim_bridge.bullet.obstacles import Obstacle, ObstacleError
from sim_bridge.scenario.fields import (
    Check,
    ScenarioError,
    name,
    not_negative,
    number,
    one_of,
    positive,
    quaternion,
    read_fields,
    refuse,
    vector,
)
from viability_bounds_pkg.exceptions import did_you_mean
from viability_bounds_pkg.parameter import Range, above
from viability_bounds_pkg.parameter_files import NODES, unknown_parameters
from viability_bounds_pkg.pose_trajectory import (
    PoseTrajectory,
    TrajectoryError,
    TrajectoryPoint,
    circle,
)

Array = NDArray[np.float64]

_ZERO = (0.0, 0.0, 0.0)
_AXES = {
    sign + letter: factor * np.eye(3)[k]
    for k, letter in enumerate("xyz")
    for sign, factor in (("", 1.0), ("-", -1.0))
}


class PoseGoal(NamedTuple):
    """An end-effector pose in the base frame from `time` on."""

    time: float
    position: tuple[float, ...]  # x, y, z, m
    orientation: tuple[float, ...]  # unit quaternion x, y, z, w


class PostureGoal(NamedTuple):
    """Joint positions from `time` on."""

    time: float
    positions: Mapping[str, float]  # rad, by joint


class TrajectoryGoal(NamedTuple):
    """A trajectory of the end effector in the base frame that begins at `time`."""

    time: float
    trajectory: PoseTrajectory


class WrenchGoal(NamedTuple):
    """The desired wrench of the end effector on its environment from `time` on."""

    time: float
    force: tuple[float, ...] = _ZERO  # N
    torque: tuple[float, ...] = _ZERO  # N m
    frame: str = ""  # in whose axes it is given; empty for the end effector's


class Push(NamedTuple):
    """An external wrench on a link, in world axes, from `time` on for `duration` seconds."""

    time: float
    duration: float
    link: str
    force: tuple[float, ...] = _ZERO  # N
    torque: tuple[float, ...] = _ZERO  # N m


class AddObstacle(NamedTuple):
    """An obstacle in the robot's world; the controller does not know of it."""

    time: float
    obstacle: Obstacle  # placed in the base frame


class RemoveObstacle(NamedTuple):
    """The removal of an obstacle."""

    time: float
    name: str


class EnableTorque(NamedTuple):
    """A call of the controller's ``enable_torque``: torque or position control."""

    time: float
    enable: bool


class ParameterChange(NamedTuple):
    """New values of a node's parameters."""

    time: float
    node: str
    values: Mapping[str, Any]


class TriggerCall(NamedTuple):
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
        wrong = [str(kind) for kind in sorted(map(str, kinds)) if kind not in _KINDS]
        hint = did_you_mean(wrong[0], {"time", *_KINDS}) if wrong else ""
        raise ScenarioError(f"{where} must have 'time' and one of {', '.join(_KINDS)}{hint}")
    kind = kinds.pop()
    time = not_negative(content["time"], f"{where}.time")
    event, read = _KINDS[kind]
    place = f"{where}.{kind}"
    if callable(read):
        return event(time, read(content[kind], place))
    fields = read_fields(content[kind], place, read, event._field_defaults)
    if kind == "push" and not {"force", "torque"} & set(fields):
        raise ScenarioError(f"{place} has no force and no torque; allowed: one of them or both")
    own_node = kind == "parameters" and fields["node"].rpartition("/")[2] in NODES
    if own_node and (unknown := unknown_parameters(fields["values"])):
        raise ScenarioError(f"{place}.values: {unknown}")
    return event(time, **fields)


def _posture(content: Any, where: str) -> Mapping[str, float]:
    joints = content if isinstance(content, dict) else ()
    fields = read_fields(content, where, dict.fromkeys(joints, number))
    return {str(joint): position for joint, position in fields.items()}


def _obstacle(content: Any, where: str) -> Obstacle:
    try:
        return Obstacle(**read_fields(content, where, _OBSTACLE, ("orientation",)))
    except ObstacleError as error:
        raise ScenarioError(f"{where}: {error}") from None


def _true_or_false(value: Any, where: str) -> bool:
    if not isinstance(value, bool):
        raise refuse(where, value, "true or false")
    return value


def _node(value: Any, where: str) -> str:
    node = name(value, where)
    if hint := did_you_mean(node, NODES) if node not in NODES else "":
        raise refuse(where, node, f"the name of a node{hint}")
    return node


def _parameters(content: Any, where: str) -> dict[str, Any]:
    if not isinstance(content, dict) or not content:
        raise refuse(where, content, "parameters and their values")
    return {str(key): _parameter(value, f"{where}.{key}") for key, value in content.items()}


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


def read_trajectory(content: Any, where: str) -> PoseTrajectory:
    """Return a trajectory in the base frame: points, or a circle.

    Raises:
        ScenarioError: an entry is unknown, malformed or out of range.
    """
    forms: dict[str, Check] = {"points": _points, "circle": _circle}
    given = read_fields(content, where, forms, optional=forms)
    try:
        return PoseTrajectory(given[one_of(forms, given, where)])
    except TrajectoryError as error:
        raise ScenarioError(f"{where}.{error}") from None


def _points(content: Any, where: str) -> list[TrajectoryPoint]:
    if not isinstance(content, list) or not content:
        raise refuse(where, content, "a list of at least one point")
    points = []
    for k, entry in enumerate(content):
        fields = read_fields(entry, f"{where}[{k}]", _POINT, ("velocity", "acceleration"))
        velocity, acceleration = np.zeros((2, 6))
        velocity[:3] = fields.get("velocity", 0.0)
        acceleration[:3] = fields.get("acceleration", 0.0)
        pose = _pose(fields, "position")
        points.append(TrajectoryPoint(fields["time"], pose, velocity, acceleration))
    return points


def _circle(content: Any, where: str) -> list[TrajectoryPoint]:
    fields = read_fields(content, where, _CIRCLE, ("phase", "turns"))
    first, second = fields["plane"]
    phase = fields.get("phase", 0.0)
    outward = math.cos(phase) * first + math.sin(phase) * second
    along = math.cos(phase) * second - math.sin(phase) * first
    return circle(
        _pose(fields, "start"),
        0.5 * fields["diameter"],
        (outward, along),
        period=fields["period"],
        turns=fields.get("turns", 1),
    )


def _pose(fields: Mapping[str, Any], place: str) -> pin.SE3:
    return pin.SE3(pin.Quaternion(np.array(fields["orientation"])), np.array(fields[place]))


def _plane(value: Any, where: str) -> tuple[Array, Array]:
    """Check the names of two axes at right angles; return them, shape (3,) each."""
    allowed = "two of x, y, z, -x, -y, -z at right angles"
    if not isinstance(value, list) or len(value) != 2 or not {*map(str, value)} <= {*_AXES}:
        raise refuse(where, value, allowed)
    first, second = (_AXES[axis] for axis in value)
    if first @ second != 0.0:
        raise refuse(where, value, allowed)
    return first, second


_POINT: dict[str, Check] = {
    "time": not_negative,
    "position": vector,
    "orientation": quaternion,
    "velocity": vector,
    "acceleration": vector,
}
_CIRCLE: dict[str, Check] = {
    "start": vector,
    "orientation": quaternion,
    "diameter": positive,
    "plane": _plane,
    "phase": number,
    "turns": partial(number, allowed=above(0.0, 1e3)),
    "period": partial(number, allowed=Range(1e-3, 1e6)),
}
_OBSTACLE: dict[str, Check] = {
    "name": name,
    "shape": name,
    "size": vector,
    "position": vector,
    "orientation": quaternion,
}
_KINDS: dict[str, tuple[Any, Check | Mapping[str, Check]]] = {
    "pose": (PoseGoal, {"position": vector, "orientation": quaternion}),
    "posture": (PostureGoal, _posture),
    "trajectory": (TrajectoryGoal, read_trajectory),
    "wrench": (WrenchGoal, {"force": vector, "torque": vector, "frame": name}),
    "push": (Push, {"link": name, "duration": positive, "force": vector, "torque": vector}),
    "obstacle": (AddObstacle, _obstacle),
    "remove_obstacle": (RemoveObstacle, {"name": name}),
    "enable_torque": (EnableTorque, _true_or_false),
    "parameters": (ParameterChange, {"node": _node, "values": _parameters}),
    "call": (TriggerCall, {"service": name}),
}
"""By the entry's name: the event, and its fields or a function that reads its only field."""
