"""The entry ``trajectory`` of a scenario file: points, or a circle."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from sim_bridge.scenario.fields import (
    ScenarioError,
    number,
    one_of,
    only,
    quaternion,
    refuse,
    vector,
)
from sim_bridge.scenario.pose_path import PathPoint, angle_between, circle

_AXES = {
    sign + letter: tuple(value if i == k else 0.0 for i in range(3))
    for k, letter in enumerate("xyz")
    for sign, value in (("", 1.0), ("-", -1.0))
}
_HALF_TURN = 0.99 * math.pi
_ZERO = [0.0, 0.0, 0.0]


def read_points(fields: dict, where: str) -> tuple[PathPoint, ...]:
    """Return the points of a trajectory.

    Raises:
        ScenarioError: an entry is unknown, malformed or out of range.
    """
    only(fields, ("points", "circle"), where)
    form = one_of(fields, ("points", "circle"), where)
    content, where = fields[form], f"{where}.{form}"
    if form == "points":
        return _points(content, where)
    if not isinstance(content, dict):
        raise refuse(where, content, "fields and their values")
    return _circle(content, where)


def _points(entries: Any, where: str) -> tuple[PathPoint, ...]:
    if not isinstance(entries, list) or not entries:
        raise refuse(where, entries, "a list of at least one point")
    points: list[PathPoint] = []
    for k, fields in enumerate(entries):
        here = f"{where}[{k}]"
        if not isinstance(fields, dict):
            raise refuse(here, fields, "fields and their values")
        only(fields, PathPoint._fields, here)
        point = PathPoint(
            number(fields.get("time"), f"{here}.time", zero=True),
            vector(fields.get("position"), 3, f"{here}.position"),
            quaternion(fields.get("orientation"), f"{here}.orientation"),
            vector(fields.get("velocity", _ZERO), 3, f"{here}.velocity"),
            vector(fields.get("acceleration", _ZERO), 3, f"{here}.acceleration"),
        )
        if points and point.time <= points[-1].time:
            allowed = f"more than {points[-1].time:g}, the time of the point before"
            raise refuse(f"{here}.time", point.time, allowed)
        if points and angle_between(points[-1].orientation, point.orientation) > _HALF_TURN:
            raise ScenarioError(f"{here}.orientation is half a turn from the point before")
        points.append(point)
    return tuple(points)


def _circle(fields: dict, where: str) -> tuple[PathPoint, ...]:
    only(
        fields,
        ("centre", "start", "radius", "diameter", "plane", "normal", "phase", "turns", "period",
         "ramp", "orientation"),
        where,
    )  # fmt: skip
    size = one_of(fields, ("radius", "diameter"), where)
    radius = number(fields[size], f"{where}.{size}") * (1.0 if size == "radius" else 0.5)
    axes = _axes(fields, where)
    phase = number(fields.get("phase", 0.0), f"{where}.phase", negative=True)
    place = one_of(fields, ("centre", "start"), where)
    centre = np.array(vector(fields[place], 3, f"{where}.{place}"))
    if place == "start":
        centre -= radius * (math.cos(phase) * axes[0] + math.sin(phase) * axes[1])
    turns = number(fields.get("turns", 1), f"{where}.turns")
    period = number(fields.get("period"), f"{where}.period")
    ramp = None
    if "ramp" in fields:
        ramp = number(fields["ramp"], f"{where}.ramp")
        if ramp > turns * period:
            allowed = f"at most {turns * period:g}, the time of all turns"
            raise refuse(f"{where}.ramp", fields["ramp"], allowed)
    orientation = quaternion(fields.get("orientation"), f"{where}.orientation")
    return circle(
        centre, radius, axes, orientation, period=period, turns=turns, phase=phase, ramp=ramp
    )


def _axes(fields: dict, where: str) -> tuple[np.ndarray, np.ndarray]:
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
    # Where x points in the plane; y where x hardly does.
    first = np.array(_AXES["x" if abs(normal[0]) < 0.9 else "y"])
    first -= (first @ normal) * normal
    first /= np.linalg.norm(first)
    return first, np.cross(normal, first)
