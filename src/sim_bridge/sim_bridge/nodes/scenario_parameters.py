# SPDX-License-Identifier: Apache-2.0
"""The scenario node's parameters and their checks."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sim_bridge.scenario.events import PostureGoal, WrenchGoal
from sim_bridge.scenario.fields import ScenarioError
from sim_bridge.scenario.scenario import ScenarioConfiguration, load_scenario
from viability_bounds_pkg.exceptions import SettingError
from viability_bounds_pkg.ros.parameters import POSITIVE, Parameter, above, joint_names
from viability_bounds_pkg.ros.robot_parameters import (
    ROBOT_TABLE,
    locked_joints,
    position_limits,
    robot_urdf,
)

TABLE = (
    Parameter("robot_name", str, "name of the robot in the report", default="robot"),
    *ROBOT_TABLE,
    Parameter("base_frame", str, "frame of pose goals; fixed to the URDF's root"),
    Parameter("end_effector_frame", str, "frame that pose goals move"),
    Parameter("velocity_max", list[float], "speed limits, rad/s", per_joint=True, within=POSITIVE),
    Parameter("scenario", str, "YAML file of the scenario"),
    Parameter(
        "ready_timeout",
        float,
        "how long the other nodes may take to start, s",
        default=180.0,
        within=above(0.0, 3600.0),
    ),
)


def make_configuration(values: Mapping[str, Any]) -> ScenarioConfiguration:
    """Check parameter values and read the scenario.

    Raises:
        SettingError: a value cannot be used.
    """
    joints = joint_names(values)
    try:
        scenario = load_scenario(values["scenario"])
    except ScenarioError as error:
        raise SettingError("scenario", values["scenario"], str(error)) from error
    for event in scenario.events:
        if isinstance(event, PostureGoal) and set(joints) - set(event.positions):
            missing = ", ".join(joint for joint in joints if joint not in event.positions)
            allowed = f"postures of all 'joints'; at {event.time:g} s there is none of {missing}"
            raise SettingError("scenario", values["scenario"], allowed)
    frames = "", values["end_effector_frame"], values["base_frame"]
    for event in scenario.events:
        if isinstance(event, WrenchGoal) and event.frame not in frames:
            allowed = (
                f"wrenches in the axes of {' or '.join(frames[1:])}; at {event.time:g} s there is "
                f"one in those of {event.frame!r}"
            )
            raise SettingError("scenario", values["scenario"], allowed)
    q_min, q_max = position_limits(values, joints)
    return ScenarioConfiguration(
        name=values["robot_name"],
        urdf=robot_urdf(values["robot_description"]),
        joints=joints,
        locked=locked_joints(values),
        base_frame=values["base_frame"],
        end_effector_frame=values["end_effector_frame"],
        q_min=q_min,
        q_max=q_max,
        v_max=values["velocity_max"],
        tau_max=values["torque_max"],
        scenario=scenario,
        ready_timeout=values["ready_timeout"],
    )
