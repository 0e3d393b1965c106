# SPDX-License-Identifier: Apache-2.0
"""Compares a robot's parameters with its URDF: names, degrees for radians, wider limits."""

from __future__ import annotations

import math
from collections.abc import Iterator
from xml.etree import ElementTree

from viability_bounds_pkg.exceptions import SettingError
from viability_bounds_pkg.robot.configuration import RobotConfiguration, urdf_joints

_TURNS_MAX = 2.0
"""Turns of a joint with limits from which on its angles are surely degrees."""

_ANGLES = ("position_min", "position_max", "start_positions")
_LIMITS = (("velocity_max", "velocity"), ("torque_max", "effort"))
_SLACK = 1e-3
"""Relative excess over limits of the URDF that rounding explains."""


def check_with_urdf(config: RobotConfiguration, urdf: str) -> list[str]:
    """Return what is unusual about parameters of a robot, a line each.

    Args:
        config: its parameters.
        urdf: text of its URDF.

    Raises:
        SettingError: a joint that the URDF does not have, or angles that must be degrees.
    """
    elements = urdf_joints(urdf, config.joints)
    return [
        line
        for index, name in enumerate(config.joints)
        for line in _unusual(config, index, elements[name])
    ]


def _unusual(config: RobotConfiguration, index: int, joint: ElementTree.Element) -> Iterator[str]:
    name, limit = config.joints[index], joint.find("limit")
    if joint.get("type") == "revolute":
        for parameter in _ANGLES:
            values = getattr(config, parameter, ())
            turns = abs(values[index]) / math.tau if len(values) else 0.0
            if _TURNS_MAX < turns < math.inf:
                allowed = f"rad; {values[index]:g} of {name} are {turns:.0f} turns: degrees?"
                raise SettingError(parameter, values, allowed)
    if limit is None or joint.get("type") == "continuous":
        return
    ends = (("position_min", "lower", -1.0), ("position_max", "upper", 1.0))
    for parameter, key, sign in (*ends, *((p, k, 1.0) for p, k in _LIMITS)):
        values, of_urdf = getattr(config, parameter, ()), float(limit.get(key, "nan"))
        if len(values) and sign * (values[index] - of_urdf) > _SLACK * max(1.0, abs(of_urdf)):
            yield (
                f"parameter '{parameter}' is {values[index]:g} for {name}, beyond the {of_urdf:g} "
                "of the URDF"
            )
    start = getattr(config, "start_positions", None)
    low, high = config.position_min, config.position_max
    if start is not None and not low[index] <= start[index] <= high[index]:
        yield (
            f"parameter 'start_positions' is {start[index]:g} for {name}, outside its position "
            f"limits, {low[index]:g} to {high[index]:g}"
        )
