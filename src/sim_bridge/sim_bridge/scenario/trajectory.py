# SPDX-License-Identifier: Apache-2.0
"""The entry ``trajectory`` of a scenario file: points, or a circle."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from sim_bridge.scenario.fields import ScenarioEntry, ScenarioError
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
_ZERO = [0.0, 0.0, 0.0]
_POINT_FIELDS = ("time", "position", "orientation", "velocity", "acceleration")
_CIRCLE_FIELDS = (
    ("centre", "start", "radius", "diameter", "plane", "normal", "phase", "turns")
    + ("period", "ramp", "orientation")
)  # fmt: skip


def read_trajectory(content: Any, where: str) -> PoseTrajectory:
    """Return a trajectory in the base frame.

    Raises:
        ScenarioError: an entry is unknown, malformed or out of range.
    """
    entry = ScenarioEntry(content, where, ("points", "circle"))
    if entry.one_of(("points", "circle")) == "circle":
        fields = ScenarioEntry(entry.fields["circle"], f"{where}.circle", _CIRCLE_FIELDS)
        return PoseTrajectory(_circle(fields))
    points = entry.fields["points"]
    if not isinstance(points, list) or not points:
        raise entry.refuse("points", "a list of at least one point")
    try:
        return PoseTrajectory(
            [
                _point(ScenarioEntry(point, f"{where}.points[{k}]", _POINT_FIELDS))
                for k, point in enumerate(points)
            ]
        )
    except TrajectoryError as error:
        raise ScenarioError(f"{where}.{error}") from None


def _point(entry: ScenarioEntry) -> TrajectoryPoint:
    velocity, acceleration = np.zeros((2, 6))
    velocity[:3] = entry.vector("velocity", default=_ZERO)
    acceleration[:3] = entry.vector("acceleration", default=_ZERO)
    pose = pin.SE3(_rotation(entry), np.array(entry.vector("position")))
    return TrajectoryPoint(entry.number("time", zero=True), pose, velocity, acceleration)


def _rotation(entry: ScenarioEntry) -> Array:
    """Return the field ``orientation`` as a rotation matrix, shape (3, 3)."""
    x_y_z_w = np.array(entry.quaternion("orientation"))
    rotation: Array = pin.Quaternion(x_y_z_w).toRotationMatrix()
    return rotation


def _circle(entry: ScenarioEntry) -> list[TrajectoryPoint]:
    size = entry.one_of(("radius", "diameter"))
    radius = entry.number(size) * (1.0 if size == "radius" else 0.5)
    e_1, e_2 = _axes(entry)
    phase = entry.number("phase", 0.0, negative=True)
    outward = math.cos(phase) * e_1 + math.sin(phase) * e_2
    along = math.cos(phase) * e_2 - math.sin(phase) * e_1
    place = entry.one_of(("centre", "start"))
    start = np.array(entry.vector(place))
    if place == "centre":
        start += radius * outward
    turns, period = entry.number("turns", 1), entry.number("period")
    ramp = None
    if "ramp" in entry.fields:
        ramp = entry.number("ramp")
        if ramp > turns * period:
            raise entry.refuse("ramp", f"at most {turns * period:g}, the time of all turns")
    pose = pin.SE3(_rotation(entry), start)
    return circle(pose, radius, (outward, along), period=period, turns=turns, ramp=ramp)


def _axes(entry: ScenarioEntry) -> tuple[Array, Array]:
    """Return the unit vectors that span the circle's plane, shape (3,) each."""
    if entry.one_of(("plane", "normal")) == "plane":
        plane, allowed = entry.fields["plane"], "two of x, y, z, -x, -y, -z at right angles"
        if not isinstance(plane, list) or len(plane) != 2 or not {*map(str, plane)} <= {*_AXES}:
            raise entry.refuse("plane", allowed)
        first, second = (np.array(_AXES[axis]) for axis in plane)
        if first @ second != 0.0:
            raise entry.refuse("plane", allowed)
        return first, second
    normal = np.array(entry.vector("normal"))
    length = np.linalg.norm(normal)
    if length < 1e-9:
        raise entry.refuse("normal", "a vector that is not zero")
    normal /= length
    # The projection of x on the plane; of y where x is nearly normal to it.
    first = np.array(_AXES["x" if abs(normal[0]) < 0.9 else "y"])
    first -= (first @ normal) * normal
    first /= np.linalg.norm(first)
    return first, np.cross(normal, first)
