# SPDX-License-Identifier: Apache-2.0
"""The entry ``trajectory`` of a scenario file: points, or a circle."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from sim_bridge.scenario.fields import (
    Check,
    ScenarioError,
    not_negative,
    number,
    one_of,
    positive,
    quaternion,
    read_fields,
    refuse,
    vector,
)
from viability_bounds_pkg.pose_trajectory import (
    PoseTrajectory,
    TrajectoryError,
    TrajectoryPoint,
    circle,
)

Array = NDArray[np.float64]

_AXES = {
    sign + letter: tuple(value if i == k else 0.0 for i in range(3))
    for k, letter in enumerate("xyz")
    for sign, value in (("", 1.0), ("-", -1.0))
}


def _plane(value: Any, where: str) -> tuple[Array, Array]:
    """Check the names of two axes at right angles; return them, shape (3,) each."""
    allowed = "two of x, y, z, -x, -y, -z at right angles"
    if not isinstance(value, list) or len(value) != 2 or not {*map(str, value)} <= {*_AXES}:
        raise refuse(where, value, allowed)
    first, second = (np.array(_AXES[axis]) for axis in value)
    if first @ second != 0.0:
        raise refuse(where, value, allowed)
    return first, second


def _normal(value: Any, where: str) -> tuple[Array, Array]:
    """Check the normal of a plane; return the unit vectors that span it, shape (3,) each."""
    normal = np.array(vector(value, where))
    length = np.linalg.norm(normal)
    if length < 1e-9:
        raise refuse(where, value, "a vector that is not zero")
    normal /= length
    # The projection of x on the plane; of y where x is nearly normal to it.
    first = np.array(_AXES["x" if abs(normal[0]) < 0.9 else "y"])
    first -= (first @ normal) * normal
    first /= np.linalg.norm(first)
    return first, np.cross(normal, first)


_POINT: dict[str, Check] = {
    "time": not_negative,
    "position": vector,
    "orientation": quaternion,
    "velocity": vector,
    "acceleration": vector,
}
_CIRCLE: dict[str, Check] = {
    "centre": vector,
    "start": vector,
    "radius": positive,
    "diameter": positive,
    "plane": _plane,
    "normal": _normal,
    "phase": number,
    "turns": positive,
    "period": positive,
    "ramp": positive,
    "orientation": quaternion,
}


def read_trajectory(content: Any, where: str) -> PoseTrajectory:
    """Return a trajectory in the base frame.

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
        pose = _pose(fields, np.array(fields["position"]))
        points.append(TrajectoryPoint(fields["time"], pose, velocity, acceleration))
    return points


def _circle(content: Any, where: str) -> list[TrajectoryPoint]:
    fields = read_fields(content, where, _CIRCLE, _CIRCLE.keys() - {"period", "orientation"})
    size = one_of(("radius", "diameter"), fields, where)
    radius = fields[size] * (1.0 if size == "radius" else 0.5)
    e_1, e_2 = fields[one_of(("plane", "normal"), fields, where)]
    phase = fields.get("phase", 0.0)
    outward = math.cos(phase) * e_1 + math.sin(phase) * e_2
    along = math.cos(phase) * e_2 - math.sin(phase) * e_1
    place = one_of(("centre", "start"), fields, where)
    start = np.array(fields[place])
    if place == "centre":
        start += radius * outward
    turns, period, ramp = fields.get("turns", 1), fields["period"], fields.get("ramp")
    if ramp is not None and ramp > turns * period:
        allowed = f"at most {turns * period:g}, the time of all turns"
        raise refuse(f"{where}.ramp", ramp, allowed)
    pose = _pose(fields, start)
    return circle(pose, radius, (outward, along), period=period, turns=turns, ramp=ramp)


def _pose(fields: Mapping[str, Any], position: Array) -> pin.SE3:
    return pin.SE3(pin.Quaternion(np.array(fields["orientation"])), position)
