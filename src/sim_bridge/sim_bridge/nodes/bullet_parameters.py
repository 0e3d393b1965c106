# SPDX-License-Identifier: Apache-2.0
"""The robot node's parameters: the table, their checks, and the robot made of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any
from xml.etree import ElementTree

import numpy as np

from sim_bridge.bullet.joint_friction import DEFAULT_STRIBECK_VELOCITY, JointFriction
from sim_bridge.bullet.obstacles import ContactMaterial
from sim_bridge.bullet.robot import BulletRobot
from sim_bridge.nodes.ft_sensor import SENSOR_TABLE, SensorConfiguration, sensor_configuration
from sim_bridge.urdf.arm import ConfiguredArm
from viability_bounds_pkg.exceptions import SettingError
from viability_bounds_pkg.robot_description import RobotDescriptionError
from viability_bounds_pkg.ros.parameters import (
    FINITE,
    NOT_NEGATIVE,
    POSITIVE,
    Parameter,
    Range,
    above,
    given_or,
    joint_names,
)
from viability_bounds_pkg.ros.robot_parameters import (
    ROBOT_TABLE,
    locked_joints,
    position_limits,
    robot_urdf,
)

CLOCKS = ("real_time", "lockstep")
_MATERIAL = ContactMaterial()

TABLE = (
    *ROBOT_TABLE,
    Parameter(
        "velocity_max",
        list[float],
        "speed limits, rad/s",
        per_joint=True,
        within=POSITIVE,
    ),
    Parameter(
        "start_positions",
        list[float],
        "positions at start and after reset, rad",
        per_joint=True,
        within=FINITE,
    ),
    Parameter("rate_hz", float, "rate of the control loop, Hz", within=above(0.0, 1e4)),
    Parameter(
        "physics_step_max",
        float,
        "longest physics step, s",
        default=0.001,
        within=above(0.0, 1.0),
    ),
    Parameter(
        "clock",
        str,
        "real_time: a period lasts its time on the wall clock; lockstep: until its command comes",
        default="real_time",
        choices=CLOCKS,
    ),
    Parameter(
        "command_timeout",
        int,
        "control periods that the last command is held for before the robot brakes",
        default=5,
        within=Range(1, 1000),
    ),
    Parameter("start_paused", bool, "wait for the pause service before moving", default=False),
    Parameter(
        "pause_after",
        float,
        "robot time after which it pauses by itself, s since it began to move; 0: never",
        default=0.0,
        live=True,
        within=Range(0.0, 1e5),
    ),
    Parameter("publish_clock", bool, "publish /clock", default=False),
    Parameter(
        "friction_coulomb",
        list[float],
        "dry friction of moving joints, N m; none if empty",
        default=np.zeros(0),
        per_joint=True,
        within=NOT_NEGATIVE,
    ),
    Parameter(
        "friction_static",
        list[float],
        "dry friction of joints at rest, N m; that of moving ones if empty",
        default=np.zeros(0),
        per_joint=True,
        within=NOT_NEGATIVE,
        note="at least friction_coulomb",
    ),
    Parameter(
        "friction_viscous",
        list[float],
        "friction that grows with speed, N m s/rad; none if empty",
        default=np.zeros(0),
        per_joint=True,
        within=NOT_NEGATIVE,
    ),
    Parameter(
        "stribeck_velocity",
        list[float],
        "speed at which static has become Coulomb friction but for 1/e of the difference, rad/s; "
        f"{DEFAULT_STRIBECK_VELOCITY} if empty",
        default=np.zeros(0),
        per_joint=True,
        within=POSITIVE,
    ),
    Parameter(
        "torque_bias",
        list[float],
        "torque of the motors beyond what is commanded and reported, N m; none if empty",
        default=np.zeros(0),
        per_joint=True,
        within=FINITE,
    ),
    Parameter(
        "mass_scale_links",
        list[str],
        "links with another mass than in the URDF",
        default=(),
        note="each once",
    ),
    Parameter(
        "mass_scales",
        list[float],
        "factors for their masses and inertias",
        default=np.zeros(0),
        within=POSITIVE,
        note="one for each of 'mass_scale_links'",
    ),
    Parameter(
        "external_wrench_timeout",
        float,
        "how long a push lasts, s of robot time",
        default=0.5,
        within=above(0.0, 3600.0),
    ),
    Parameter(
        "obstacle_friction",
        float,
        "Coulomb's coefficient between robot and obstacles",
        default=_MATERIAL.friction,
        within=Range(0.0, 10.0),
    ),
    Parameter(
        "obstacle_stiffness",
        float,
        "stiffness of obstacles, N/m; 2e5: 0.5 mm at 100 N",
        default=_MATERIAL.stiffness,
        within=above(0.0, 1e9),
    ),
    Parameter(
        "obstacle_damping",
        float,
        "damping of obstacles, N s/m",
        default=_MATERIAL.damping,
        within=Range(0.0, 1e9),
    ),
    *SENSOR_TABLE,
)


@dataclass(frozen=True)
class BulletConfiguration(ConfiguredArm):
    """Checked parameters of the robot node; arrays of shape (n,) in `joints` order."""

    joint_friction: JointFriction
    mass_scales: dict[str, float]
    q_start: np.ndarray
    dt: float
    substeps: int
    lockstep: bool
    command_timeout: int
    start_paused: bool
    pause_after: float
    publish_clock: bool
    external_wrench_timeout: float
    material: ContactMaterial
    sensor: SensorConfiguration


def make_configuration(values: Mapping[str, Any]) -> BulletConfiguration:
    """Check parameter values and read the URDF.

    Raises:
        SettingError: a value cannot be used.
    """
    joints = joint_names(values)
    urdf = robot_urdf(values["robot_description"])
    dt = 1.0 / values["rate_hz"]
    q_min, q_max = position_limits(values, joints)
    return BulletConfiguration(
        urdf=urdf,
        joints=joints,
        locked=locked_joints(values),
        q_min=q_min,
        q_max=q_max,
        v_max=values["velocity_max"],
        tau_max=values["torque_max"],
        joint_friction=_joint_friction(values, joints),
        mass_scales=_mass_scales(values),
        q_start=values["start_positions"],
        dt=dt,
        # The rounding keeps 1 kHz with steps of 1 ms from becoming two steps of 0.5 ms.
        substeps=max(1, int(np.ceil(dt / values["physics_step_max"] - 1e-9))),
        lockstep=values["clock"] == "lockstep",
        command_timeout=values["command_timeout"],
        start_paused=values["start_paused"],
        pause_after=values["pause_after"],
        publish_clock=values["publish_clock"],
        external_wrench_timeout=values["external_wrench_timeout"],
        material=ContactMaterial(
            values["obstacle_friction"],
            values["obstacle_stiffness"],
            values["obstacle_damping"],
        ),
        sensor=sensor_configuration(values),
    )


def _joint_friction(values: Mapping[str, Any], joints: tuple[str, ...]) -> JointFriction:
    zero = np.zeros(len(joints))
    coulomb = given_or(values, "friction_coulomb", zero)
    static = given_or(values, "friction_static", coulomb)
    if not (static >= coulomb).all():
        raise SettingError("friction_static", static, "at least friction_coulomb everywhere")
    return JointFriction(
        len(joints),
        friction_coulomb=coulomb,
        friction_static=static,
        friction_viscous=given_or(values, "friction_viscous", zero),
        stribeck_velocity=given_or(values, "stribeck_velocity", zero + DEFAULT_STRIBECK_VELOCITY),
        torque_bias=given_or(values, "torque_bias", zero),
        rotor_inertia=given_or(values, "rotor_inertia", zero),
    )


def _mass_scales(values: Mapping[str, Any]) -> dict[str, float]:
    links, scales = values["mass_scale_links"], values["mass_scales"]
    if len(set(links)) != len(links):
        raise SettingError("mass_scale_links", links, "links of the URDF, each once")
    if len(links) != len(scales):
        allowed = f"{len(links)} numbers, one for each of 'mass_scale_links'"
        raise SettingError("mass_scales", scales, allowed)
    return dict(zip(links, map(float, scales), strict=True))


def make_robot(config: BulletConfiguration, values: Mapping[str, Any]) -> BulletRobot:
    """Return the robot that the parameters describe.

    Raises:
        SettingError: a URDF that does not load, or a joint or link that it does not have.
    """
    try:
        return BulletRobot(
            config.urdf,
            config.joints,
            locked_positions=config.locked,
            physics_dt=config.dt / config.substeps,
            joint_friction=config.joint_friction,
            mass_scales=config.mass_scales,
            material=config.material,
            sensor_frame=config.sensor.frame,
        )
    except RobotDescriptionError as error:
        name, allowed = _culprit(config)
        raise SettingError(name, values[name], f"{allowed} ({error})") from error


def _culprit(config: BulletConfiguration) -> tuple[str, str]:
    """Return the parameter that prevents the robot, and its allowed values."""
    root = ElementTree.fromstring(config.urdf)
    joints = {joint.get("name") for joint in root.iter("joint")}
    if not joints >= set(config.joints):
        return "joints", "joints of the URDF"
    if not joints - set(config.joints) >= set(config.locked):
        return "locked_joints", "other joints of the URDF"
    if not {link.get("name") for link in root.iter("link")} >= set(config.mass_scales):
        return "mass_scale_links", "links of the URDF"
    carriers = {parent.get("link") for parent in root.iter("parent")}
    if config.sensor.frame and config.sensor.frame not in carriers:
        return "ft_frame", "a link of the URDF that carries others, or empty"
    return "robot_description", "a URDF that PyBullet can load"
