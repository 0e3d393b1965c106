# SPDX-License-Identifier: Apache-2.0
"""Joints of a URDF: their limits, and their units."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import lru_cache
from xml.etree import ElementTree

from viability_bounds_pkg.exceptions import SettingError, did_you_mean
from viability_bounds_pkg.robot.files import RobotDescriptionError, read_urdf

LIMITS_OF_URDF = {
    "position_min": "lower",
    "position_max": "upper",
    "velocity_max": "velocity",
    "torque_max": "effort",
}
"""Parameters that are taken from the URDF where they are not given, and its attribute."""


@lru_cache(maxsize=16)
def urdf_limits(source: str, joints: tuple[str, ...]) -> Mapping[str, list[float | None]]:
    """Return the limits that a URDF gives joints, in their order, by `LIMITS_OF_URDF`.

    Read once: parameters may change while nodes control a robot. Limits are in rad, rad/s and N m,
    and None where there is none to use.

    Raises:
        SettingError: there is no such URDF, or it lacks a joint.
    """
    try:
        elements = joint_elements(read_urdf(source), joints)
    except RobotDescriptionError as error:
        raise SettingError("robot_description", source, f"a URDF ({error})") from error
    return {
        name: [urdf_limit(each, key) for each in elements] for name, key in LIMITS_OF_URDF.items()
    }


def joint_elements(urdf: str, joints: Sequence[str]) -> list[ElementTree.Element]:
    """Return the elements of a URDF's joints; raise `SettingError` if it lacks one."""
    # Those of transmissions have the same names, and nothing to compare with.
    elements = {
        each.get("name", ""): each for each in ElementTree.fromstring(urdf).iterfind("joint")
    }
    for name in joints:
        if name not in elements:
            movable = [each for each, e in elements.items() if e.get("type") != "fixed"]
            hint = did_you_mean(name, movable) or f": {', '.join(movable)}"
            raise SettingError("joints", name, f"joints of the URDF{hint}")
    return [elements[name] for name in joints]


def units_of(urdf: str, joints: Sequence[str]) -> list[str]:
    """Return the unit of each joint's position: "m" of slides, "rad" of others."""
    kinds = [each.get("type") for each in joint_elements(urdf, joints)]
    return ["m" if kind == "prismatic" else "rad" for kind in kinds]


def list_units(units: Sequence[str], per: str = "") -> str:
    """Return the unit of all joints, such as "rad/s, m/s of slides", from that of each."""
    kinds = [f"{unit}{per}" for unit in ("rad", "m") if unit in units]
    return f"{', '.join(kinds)} of slides" if len(kinds) > 1 else kinds[0]


def urdf_limit(joint: ElementTree.Element, key: str) -> float | None:
    """Return a limit of a joint of a URDF, None where there is none to use."""
    if joint.get("type") == "continuous" and key in ("lower", "upper"):
        return math.inf if key == "upper" else -math.inf
    limit = joint.find("limit")
    try:
        # The format gives positions a default of 0.
        value = float("nan" if limit is None else limit.get(key, "0"))
    except ValueError:
        return None
    usable = math.isfinite(value) and (value > 0.0 or key in ("lower", "upper"))
    return value if usable else None
