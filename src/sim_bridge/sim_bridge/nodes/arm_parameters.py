"""Parameters of the arm that the robot node simulates and the scenario node reports on."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from viability_bounds_pkg.ros.parameters import Parameter, joint_names
from viability_bounds_pkg.ros.robot_parameters import (
    ROBOT_TABLE,
    all_positive,
    locked_joints,
    position_limits,
    robot_urdf,
)

ARM_TABLE = (
    *ROBOT_TABLE,
    Parameter("velocity_max", list[float], "velocity limits, rad/s"),
)


def arm_settings(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields of `ConfiguredArm` by name.

    Raises:
        SettingError: a value cannot be used.
    """
    joints = joint_names(values)
    q_min, q_max = position_limits(values, joints)
    return {
        "urdf": robot_urdf(values),
        "joints": joints,
        "locked": locked_joints(values),
        "q_min": q_min,
        "q_max": q_max,
        "v_max": all_positive(values, "velocity_max", joints),
        "tau_max": all_positive(values, "torque_max", joints),
    }
