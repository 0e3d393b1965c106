# SPDX-License-Identifier: Apache-2.0
"""The robot node's parameters, and the robot made of them."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from sim_bridge.bullet.friction import DEFAULT_STRIBECK_VELOCITY, JointFriction
from sim_bridge.bullet.obstacles import ContactMaterial
from sim_bridge.bullet.robot import BulletRobot
from sim_bridge.bullet.sensor import SensorConfiguration
from sim_bridge.hardware import Imperfections, Motors
from viability_bounds_pkg.exceptions import SettingError, did_you_mean
from viability_bounds_pkg.joint_limits import JointLimitsError
from viability_bounds_pkg.node.bounds_parameters import limits_of
from viability_bounds_pkg.parameter import (
    FINITE,
    NEGATIVE,
    NOT_NEGATIVE,
    POSITIVE,
    Range,
    above,
    group,
    joint_amounts,
    joint_numbers,
    number,
    numbers,
    switch,
    text,
    texts,
    timeout,
    whole_number,
)
from viability_bounds_pkg.robot.configuration import (
    ControlRate,
    LimitedRobotConfiguration,
    load_model,
)
from viability_bounds_pkg.robot.files import RobotDescriptionError
from viability_bounds_pkg.robot.gravity import TorqueConvention
from viability_bounds_pkg.stop import CoordinatedStop

Array = NDArray[np.float64]

CLOCKS = ("real_time", "lockstep")

_OBSERVER_TIME = 0.002
"""Of the drives' own stop, s: their velocities are exact, and they know their motors' torque."""


@dataclass(frozen=True, eq=False, kw_only=True)
class BulletConfiguration(ControlRate, TorqueConvention, LimitedRobotConfiguration):
    """Parameters of the robot node; arrays of shape (n,) in `joints` order.

    Attributes:
        urdf: text of the URDF.
    """

    start_positions: Array = joint_numbers("positions at start and after reset, rad", FINITE)
    physics_step_max: float = number("longest physics step, s", above(0.0, 1.0), default=0.001)
    clock: str = text(
        "real_time: by the wall clock; lockstep: each period waits for its command",
        default="real_time",
        choices=CLOCKS,
    )
    command_timeout: int = whole_number(
        "control periods for which the last command is held; then the robot stops itself",
        Range(1, 1000),
        default=5,
    )
    acceleration_min: Array = joint_numbers(
        "lower acceleration limits of the stop, rad/s^2; full brake torque if empty",
        NEGATIVE,
        default=(),
        note="together with acceleration_max",
    )
    acceleration_max: Array = joint_numbers(
        "upper acceleration limits of the stop, rad/s^2",
        POSITIVE,
        default=(),
        note="together with acceleration_min",
    )
    start_paused: bool = switch("wait for the pause service before moving", default=False)
    pause_after: float = number(
        "robot time after which it pauses, s; 0: never",
        Range(0.0, 1e5),
        default=0.0,
        live=True,
    )
    publish_clock: bool = switch("publish /clock", default=False)
    friction_coulomb: Array = joint_amounts("dry friction in motion, N m; none if empty")
    friction_static: Array = joint_numbers(
        "dry friction at rest, N m; that in motion if empty",
        NOT_NEGATIVE,
        default=(),
        note="at least friction_coulomb",
    )
    friction_viscous: Array = joint_amounts("viscous friction, N m s/rad; none if empty")
    stribeck_velocity: Array = joint_numbers(
        "speed of the change from static to Coulomb friction, rad/s; "
        f"{DEFAULT_STRIBECK_VELOCITY} if empty",
        POSITIVE,
        if_empty=DEFAULT_STRIBECK_VELOCITY,
    )
    mass_scale_links: tuple[str, ...] = texts(
        "links whose mass differs from the URDF", default=(), note="each once"
    )
    mass_scales: Array = numbers(
        "factors for their masses and inertias",
        POSITIVE,
        default=(),
        note="one for each of 'mass_scale_links'",
    )
    external_wrench_timeout: float = timeout("how long a push lasts, s of robot time", default=0.5)
    material: ContactMaterial = group(ContactMaterial, "obstacle_")
    sensor: SensorConfiguration = group(SensorConfiguration)
    imperfections: Imperfections = group(Imperfections)
    urdf: str = field(init=False)

    def __post_init__(self) -> None:
        """Check what concerns several parameters, and read the URDF."""
        super().__post_init__()
        static = self.friction_static
        if len(static) and not (static >= self.friction_coulomb).all():
            raise SettingError("friction_static", static, "at least friction_coulomb everywhere")
        if len(self.acceleration_min) != len(self.acceleration_max):
            name = "acceleration_max" if len(self.acceleration_min) else "acceleration_min"
            allowed = f"{len(self.joints)} numbers, because the other limit is given"
            raise SettingError(name, getattr(self, name), allowed)
        links, scales = self.mass_scale_links, self.mass_scales
        if len(set(links)) != len(links):
            raise SettingError("mass_scale_links", links, "links of the URDF, each once")
        if len(links) != len(scales):
            allowed = f"{len(links)} numbers, one for each of 'mass_scale_links'"
            raise SettingError("mass_scales", scales, allowed)
        self.imperfections.check_rate(self.rate_hz)
        object.__setattr__(self, "urdf", self.read_urdf())

    @property
    def lockstep(self) -> bool:
        """Whether a period lasts until its command comes."""
        return self.clock == "lockstep"

    @cached_property
    def substeps(self) -> int:
        """Physics steps of a control period."""
        # The rounding keeps 1 kHz with steps of 1 ms from becoming two steps of 0.5 ms.
        return max(1, math.ceil(self.dt / self.physics_step_max - 1e-9))

    @property
    def physics_dt(self) -> float:
        """Physics step, s."""
        return self.dt / self.substeps

    @property
    def scaled_links(self) -> dict[str, float]:
        """Factors for masses and inertias by link."""
        return dict(zip(self.mass_scale_links, map(float, self.mass_scales), strict=True))

    @property
    def joint_friction(self) -> JointFriction:
        """Friction and rotors of the joints."""
        static = self.friction_static
        return JointFriction(
            len(self.joints),
            friction_coulomb=self.friction_coulomb,
            friction_static=static if len(static) else self.friction_coulomb,
            friction_viscous=self.friction_viscous,
            stribeck_velocity=self.stribeck_velocity,
            rotor_inertia=self.rotor_inertia,
        )


def make_robot(config: BulletConfiguration) -> BulletRobot:
    """Return the robot that the parameters describe.

    Raises:
        SettingError: a URDF that does not load, or a joint or link that it does not have.
    """
    imperfections = config.imperfections
    motors = Motors(imperfections, config.torque_max, config.physics_dt)
    load_model(config, config.urdf)  # its error names the parameter
    root, frame = ElementTree.fromstring(config.urdf), config.sensor.ft_frame
    joints = {joint.get("name", "") for joint in root.iter("joint")} - set(config.joints)
    links = {link.get("name", "") for link in root.iter("link")}
    carriers = {parent.get("link", "") for parent in root.iter("parent")}
    for name, chosen, known, allowed in (
        ("locked_joints", config.locked_joints, joints, "other joints of the URDF"),
        ("mass_scale_links", config.mass_scale_links, links, "links of the URDF"),
        ("ft_frame", (frame,), carriers, "a link of the URDF that carries others, or empty"),
    ):
        for each in filter(None, chosen):
            if each not in known:
                raise SettingError(name, each, f"{allowed}{did_you_mean(each, known)}")
    try:
        return BulletRobot(
            config.urdf,
            config.joints,
            locked_positions=config.locked,
            physics_dt=config.physics_dt,
            joint_friction=config.joint_friction,
            motors=motors if imperfections.of_motors else None,
            mass_scales=config.scaled_links,
            material=config.material,
            sensor_frame=frame,
        )
    except RobotDescriptionError as error:
        allowed = f"a URDF that PyBullet can load ({error})"
        raise SettingError("robot_description", config.robot_description, allowed) from error


def make_stop(config: BulletConfiguration) -> CoordinatedStop | None:
    """Return the law by which the robot stops itself; None without acceleration limits.

    It keeps the robot's positions clear of the limits by the way that a joint can make from rest
    in a physics step: PyBullet's are that much ahead at most.

    Raises:
        SettingError: limits that a physics step is too long for.
    """
    if not len(config.acceleration_min):
        return None
    dt, model = config.physics_dt, load_model(config, config.urdf)
    a_max = config.acceleration_max
    clearance = 0.5 * dt * dt * np.maximum(-config.acceleration_min, a_max)
    try:
        limits = limits_of(config, clearance)
        return CoordinatedStop(
            model,
            limits,
            config.torque_max,
            dt,
            observer_time=_OBSERVER_TIME,
            motor_lag=config.imperfections.motor_lag,
        )
    except JointLimitsError as error:
        allowed = f"limits that can be kept in steps of {dt:g} s ({error})"
        raise SettingError("acceleration_max", a_max, allowed) from error
