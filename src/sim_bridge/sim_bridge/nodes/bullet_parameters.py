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
    Parameter,
    joint_names,
    per_joint,
    positive,
)
from viability_bounds_pkg.ros.robot_parameters import (
    ROBOT_TABLE,
    all_positive,
    locked_joints,
    not_negative,
    position_limits,
    robot_urdf,
)

CLOCKS = ("real_time", "lockstep")
_MATERIAL = ContactMaterial()

TABLE = (
    *ROBOT_TABLE,
    Parameter("velocity_max", list[float], "speed limits that are watched, rad/s"),
    Parameter("start_positions", list[float], "positions at start and after reset, rad"),
    Parameter("rate_hz", float, "rate of the control loop, Hz"),
    Parameter("physics_step_max", float, "longest physics step, s", default=0.001),
    Parameter("clock", str, f"one of: {', '.join(CLOCKS)}", default="real_time"),
    Parameter(
        "command_timeout",
        int,
        "control periods that the last command is held for before the robot brakes",
        default=5,
    ),
    Parameter("start_paused", bool, "wait for the pause service before moving", default=False),
    Parameter(
        "pause_after",
        float,
        "robot time after which it pauses by itself, s since it began to move; 0: never",
        default=0.0,
        live=True,
    ),
    Parameter("publish_clock", bool, "publish /clock", default=False),
    Parameter(
        "friction_coulomb",
        list[float],
        "dry friction of moving joints, N m; none if empty",
        default=np.zeros(0),
    ),
    Parameter(
        "friction_static",
        list[float],
        "dry friction of joints at rest, N m; that of moving ones if empty",
        default=np.zeros(0),
    ),
    Parameter(
        "friction_viscous",
        list[float],
        "friction that grows with speed, N m s/rad; none if empty",
        default=np.zeros(0),
    ),
    Parameter(
        "stribeck_velocity",
        list[float],
        "speed at which static has become Coulomb friction but for 1/e of the difference, rad/s; "
        f"{DEFAULT_STRIBECK_VELOCITY} if empty",
        default=np.zeros(0),
    ),
    Parameter(
        "torque_bias",
        list[float],
        "torque that the motors give beyond what they are told and report, N m; none if empty",
        default=np.zeros(0),
    ),
    Parameter(
        "mass_scale_links", list[str], "links that weigh other than the URDF says", default=()
    ),
    Parameter(
        "mass_scales",
        list[float],
        "factors for their masses and inertias",
        default=np.zeros(0),
    ),
    Parameter(
        "external_wrench_timeout", float, "how long a push lasts, s of robot time", default=0.5
    ),
    Parameter(
        "obstacle_friction",
        float,
        "Coulomb's coefficient between robot and obstacles",
        default=_MATERIAL.friction,
    ),
    Parameter(
        "obstacle_stiffness",
        float,
        "how much an obstacle resists being pressed, N/m",
        default=_MATERIAL.stiffness,
    ),
    Parameter(
        "obstacle_damping",
        float,
        "the same of the speed of being pressed, N s/m",
        default=_MATERIAL.damping,
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
    urdf = robot_urdf(values)
    if values["clock"] not in CLOCKS:
        raise SettingError("clock", values["clock"], f"one of {', '.join(CLOCKS)}")
    if values["command_timeout"] < 1:
        raise SettingError("command_timeout", values["command_timeout"], "at least 1")
    dt = 1.0 / positive(values, "rate_hz")
    q_min, q_max = position_limits(values, joints)
    q_start = per_joint(values, "start_positions", joints)
    if not np.isfinite(q_start).all():
        raise SettingError("start_positions", q_start, "finite numbers")
    return BulletConfiguration(
        urdf=urdf,
        joints=joints,
        locked=locked_joints(values),
        q_min=q_min,
        q_max=q_max,
        v_max=all_positive(values, "velocity_max", joints),
        tau_max=all_positive(values, "torque_max", joints),
        joint_friction=_joint_friction(values, joints),
        mass_scales=_mass_scales(values),
        q_start=q_start,
        dt=dt,
        # The rounding keeps 1 kHz with steps of 1 ms from becoming two steps of 0.5 ms.
        substeps=max(1, int(np.ceil(dt / positive(values, "physics_step_max") - 1e-9))),
        lockstep=values["clock"] == "lockstep",
        command_timeout=values["command_timeout"],
        start_paused=values["start_paused"],
        pause_after=positive(values, "pause_after", zero=True),
        publish_clock=values["publish_clock"],
        external_wrench_timeout=positive(values, "external_wrench_timeout"),
        material=ContactMaterial(
            positive(values, "obstacle_friction", zero=True),
            positive(values, "obstacle_stiffness"),
            positive(values, "obstacle_damping", zero=True),
        ),
        sensor=sensor_configuration(values),
    )


def _joint_friction(values: Mapping[str, Any], joints: tuple[str, ...]) -> JointFriction:
    coulomb = not_negative(values, "friction_coulomb", joints)
    static = coulomb
    if len(values["friction_static"]):
        static = not_negative(values, "friction_static", joints)
        if not (static >= coulomb).all():
            raise SettingError("friction_static", static, "at least friction_coulomb everywhere")
    stribeck: Any = DEFAULT_STRIBECK_VELOCITY
    if len(values["stribeck_velocity"]):
        stribeck = all_positive(values, "stribeck_velocity", joints)
    bias = values["torque_bias"]
    if len(bias):
        bias = per_joint(values, "torque_bias", joints)
        if not np.isfinite(bias).all():
            raise SettingError("torque_bias", bias, "finite numbers")
    return JointFriction(
        len(joints),
        friction_coulomb=coulomb,
        friction_static=static,
        friction_viscous=not_negative(values, "friction_viscous", joints),
        stribeck_velocity=stribeck,
        torque_bias=bias if len(bias) else 0.0,
        rotor_inertia=not_negative(values, "rotor_inertia", joints),
    )


def _mass_scales(values: Mapping[str, Any]) -> dict[str, float]:
    links, scales = values["mass_scale_links"], values["mass_scales"]
    if len(set(links)) != len(links):
        raise SettingError("mass_scale_links", links, "links of the URDF, each once")
    if len(links) != len(scales):
        allowed = f"{len(links)} numbers, one for each of 'mass_scale_links'"
        raise SettingError("mass_scales", scales, allowed)
    if not (np.isfinite(scales).all() and (scales > 0).all()):
        raise SettingError("mass_scales", scales, "finite numbers > 0")
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
