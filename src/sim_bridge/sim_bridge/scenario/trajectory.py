"""The entry ``trajectory`` of a scenario file: points, or a circle."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from sim_bridge.scenario.fields import (
    Fields,
    ScenarioError,
    number,
    one_of,
    only,
    quaternion,
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
_ZERO = [0.0, 0.0, 0.0]
_POINT_FIELDS = ("time", "position", "orientation", "velocity", "acceleration")
_CIRCLE_FIELDS = (
    ("centre", "start", "radius", "diameter", "plane", "normal", "phase", "turns")
    + ("period", "ramp", "orientation")
)  # fmt: skip


def read_trajectory(fields: Fields, where: str) -> PoseTrajectory:
    """Return a trajectory in the base frame.

    Raises:
        ScenarioError: an entry is unknown, malformed or out of range.
    """
    only(fields, ("points", "circle"), where)
    form = one_of(fields, ("points", "circle"), where)
    content = fields[form]
    if form == "circle":
        if not isinstance(content, dict):
            raise refuse(f"{where}.circle", content, "fields and their values")
        return PoseTrajectory(_circle(content, f"{where}.circle"))
    if not isinstance(content, list) or not content:
        raise refuse(f"{where}.points", content, "a list of at least one point")
    points = [_point(entry, f"{where}.points[{k}]") for k, entry in enumerate(content)]
    try:
        return PoseTrajectory(points)
    except TrajectoryError as error:
        raise ScenarioError(f"{where}.{error}") from None


def _point(fields: Any, where: str) -> TrajectoryPoint:
    if not isinstance(fields, dict):
        raise refuse(where, fields, "fields and their values")
    only(fields, _POINT_FIELDS, where)
    velocity, acceleration = np.zeros((2, 6))
    velocity[:3] = vector(fields.get("velocity", _ZERO), 3, f"{where}.velocity")
    acceleration[:3] = vector(fields.get("acceleration", _ZERO), 3, f"{where}.acceleration")
    return TrajectoryPoint(
        number(fields.get("time"), f"{where}.time", zero=True),
        pin.SE3(
            _rotation(fields, where),
            np.array(vector(fields.get("position"), 3, f"{where}.position")),
        ),
        velocity,
        acceleration,
    )


def _rotation(fields: Fields, where: str) -> Array:
    """Return the entry ``orientation`` as a rotation matrix, shape (3, 3)."""
    x_y_z_w = np.array(quaternion(fields.get("orientation"), f"{where}.orientation"))
    rotation: Array = pin.Quaternion(x_y_z_w).toRotationMatrix()
    return rotation


def _circle(fields: Fields, where: str) -> list[TrajectoryPoint]:
    only(fields, _CIRCLE_FIELDS, where)
    size = one_of(fields, ("radius", "diameter"), where)
    radius = number(fields[size], f"{where}.{size}") * (1.0 if size == "radius" else 0.5)
    e_1, e_2 = _axes(fields, where)
    phase = number(fields.get("phase", 0.0), f"{where}.phase", negative=True)
    outward = math.cos(phase) * e_1 + math.sin(phase) * e_2
    along = math.cos(phase) * e_2 - math.sin(phase) * e_1
    place = one_of(fields, ("centre", "start"), where)
    start = np.array(vector(fields[place], 3, f"{where}.{place}"))
    if place == "centre":
        start += radius * outward
    turns = number(fields.get("turns", 1), f"{where}.turns")
    period = number(fields.get("period"), f"{where}.period")
    ramp = None
    if "ramp" in fields:
        ramp = number(fields["ramp"], f"{where}.ramp")
        if ramp > turns * period:
            allowed = f"at most {turns * period:g}, the time of all turns"
            raise refuse(f"{where}.ramp", fields["ramp"], allowed)
    pose = pin.SE3(_rotation(fields, where), start)
    return circle(pose, radius, (outward, along), period=period, turns=turns, ramp=ramp)


def _axes(fields: Fields, where: str) -> tuple[Array, Array]:
    """Return the unit vectors that span the circle's plane, shape (3,) each."""
    if one_of(fields, ("plane", "normal"), where) == "plane":
        plane, allowed = fields["plane"], "two of x, y, z, -x, -y, -z that are at right angles"
        if not isinstance(plane, list) or len(plane) != 2 or not {*map(str, plane)} <= {*_AXES}:
            raise refuse(f"{where}.plane", plane, allowed)
        first, second = (np.array(_AXES[axis]) for axis in plane)
        if first @ second != 0.0:
            raise refuse(f"{where}.plane", plane, allowed)
        return first, second
    normal = np.array(vector(fields["normal"], 3, f"{where}.normal"))
    length = np.linalg.norm(normal)
    if length < 1e-9:
        raise refuse(f"{where}.normal", fields["normal"], "a vector that is not zero")
    normal /= length
    # The projection of x on the plane; of y where x is nearly normal to it.
    first = np.array(_AXES["x" if abs(normal[0]) < 0.9 else "y"])
    first -= (first @ normal) * normal
    first /= np.linalg.norm(first)
    return first, np.cross(normal, first)
