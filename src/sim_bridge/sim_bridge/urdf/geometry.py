"""Frames, axes and numbers as a URDF writes them."""

from __future__ import annotations

import math
from collections.abc import Iterable
from xml.etree.ElementTree import Element

import numpy as np

from viability_bounds_pkg.robot_description import RobotDescriptionError


def point_inertia(mass: float, point: np.ndarray) -> np.ndarray:
    """Return the inertia, shape (3, 3), about the origin of a point mass at `point`."""
    return mass * (point @ point * np.eye(3) - np.outer(point, point))


def joint_axis(joint: Element) -> np.ndarray:
    """Return the unit axis of `joint`, shape (3,); URDF's default is x."""
    element = joint.find("axis")
    axis = np.array([1.0, 0.0, 0.0]) if element is None else read_numbers(element, "xyz", 3)
    length = np.linalg.norm(axis)
    if length == 0.0:
        raise RobotDescriptionError(f"joint {joint.get('name')!r}: axis without a direction")
    return axis / length


def transform_of(origin: Element | None) -> np.ndarray:
    """Return the transform, shape (4, 4), of a URDF origin; identity for None."""
    (sr, sp, sy), (cr, cp, cy) = (f(read_numbers(origin, "rpy", 3)) for f in (np.sin, np.cos))
    transform = np.eye(4)
    transform[:3, :3] = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    transform[:3, 3] = read_numbers(origin, "xyz", 3)
    return transform


def roll_pitch_yaw(transform: np.ndarray) -> tuple[float, float, float]:
    """Return roll, pitch and yaw of `transform`, exact to rounding, rad."""
    r = transform[:3, :3]
    yaw = math.atan2(r[1, 0], r[0, 0])
    pitch = math.atan2(-r[2, 0], math.hypot(r[0, 0], r[1, 0]))
    # Roll from what is left once yaw is undone: taken apart, they lose digits near pitch +-pi/2.
    s, c = math.sin(yaw), math.cos(yaw)
    roll = math.atan2(s * r[0, 2] - c * r[1, 2], c * r[1, 1] - s * r[0, 1])
    return roll, pitch, yaw


def origin_attributes(transform: np.ndarray) -> dict[str, str]:
    """Return the attributes of the URDF origin that places `transform`."""
    return {"xyz": number_text(transform[:3, 3]), "rpy": number_text(roll_pitch_yaw(transform))}


def number_text(values: Iterable[float]) -> str:
    """Return `values` for a URDF, with all their digits."""
    return " ".join(repr(float(value)) for value in values)


def read_numbers(element: Element | None, name: str, count: int) -> np.ndarray:
    """Return the `count` numbers of an attribute, shape (count,); zeros where it is missing."""
    text = None if element is None else element.get(name)
    try:
        numbers = np.array([float(x) for x in text.split()]) if text else np.zeros(count)
    except ValueError:
        numbers = np.empty(0)
    if numbers.shape != (count,) or not np.isfinite(numbers).all():
        raise RobotDescriptionError(f"URDF: {name}={text!r} is not {count} finite number(s)")
    return numbers
