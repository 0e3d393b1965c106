"""Parameters that say which robot it is, for every node that loads one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from viability_bounds_pkg.robot_description import RobotDescriptionError, read_urdf
from viability_bounds_pkg.ros_parameters import Parameter, ParameterError, per_joint

ROBOT_TABLE = (
    Parameter("robot_description", str, "URDF: path or package:// URI"),
    Parameter("joints", list[str], "joints that move, base to tip, in the order of all arrays"),
    Parameter("locked_joints", list[str], "other joints that are not at zero", default=()),
    Parameter("locked_positions", list[float], "where they are, rad", default=np.zeros(0)),
    Parameter("position_min", list[float], "lower position limits, rad"),
    Parameter("position_max", list[float], "upper position limits, rad"),
    Parameter("torque_max", list[float], "torque limits of the motors, N m"),
)


def robot_urdf(values: Mapping[str, Any]) -> str:
    """Return the text of the URDF that ``robot_description`` names.

    Raises:
        ParameterError: there is none.
    """
    source = values["robot_description"]
    try:
        return read_urdf(source)
    except RobotDescriptionError as error:
        raise ParameterError("robot_description", source, f"a URDF ({error})") from error


def locked_joints(values: Mapping[str, Any]) -> dict[str, float]:
    """Return where joints are locked that are not at zero, rad by name.

    Raises:
        ParameterError: as many positions as joints are not given, or one is not finite.
    """
    names, positions = values["locked_joints"], values["locked_positions"]
    if len(names) != len(positions):
        allowed = f"{len(names)} numbers, one for each of 'locked_joints'"
        raise ParameterError("locked_positions", positions, allowed)
    if not np.isfinite(positions).all():
        raise ParameterError("locked_positions", positions, "finite numbers")
    return dict(zip(names, map(float, positions), strict=True))


def position_limits(
    values: Mapping[str, Any], joints: Sequence[str]
) -> tuple[np.ndarray, np.ndarray]:
    """Return ``position_min`` and ``position_max``, shape (n,) each, rad.

    Raises:
        ParameterError: one has the wrong length, or a range is empty.
    """
    q_min = per_joint(values, "position_min", joints)
    q_max = per_joint(values, "position_max", joints)
    if not (q_min < q_max).all():
        raise ParameterError("position_max", q_max, "above position_min everywhere")
    return q_min, q_max


def all_positive(values: Mapping[str, Any], name: str, joints: Sequence[str]) -> np.ndarray:
    """Return a parameter of one finite positive number a joint, shape (n,).

    Raises:
        ParameterError: it is something else.
    """
    value = per_joint(values, name, joints)
    if not (np.isfinite(value).all() and (value > 0).all()):
        raise ParameterError(name, value, "finite numbers > 0")
    return value
