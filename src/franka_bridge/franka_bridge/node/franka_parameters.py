# SPDX-License-Identifier: Apache-2.0
"""Parameters of the robot's node, and what is made of them."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from franka_bridge.drive import Drive
from viability_bounds_pkg.exceptions import SettingError
from viability_bounds_pkg.joint_limits import JointLimitsError
from viability_bounds_pkg.node.bounds_parameters import limits_of
from viability_bounds_pkg.parameter import (
    FINITE,
    NEGATIVE,
    POSITIVE,
    Range,
    above,
    joint_numbers,
    numbers,
    switch,
    text,
    whole_number,
)
from viability_bounds_pkg.robot.configuration import (
    ControlRate,
    LimitedRobotConfiguration,
    TaskFrames,
    load_model,
)
from viability_bounds_pkg.robot.description import frame_id
from viability_bounds_pkg.robot.files import RobotDescriptionError
from viability_bounds_pkg.robot.gravity import TorqueConvention

Array = NDArray[np.float64]

JOINTS = 7
RATE = 1000.0  # Hz
TORQUE_RATE = 1000.0
"""libfranka's limit of torque rates, N m/s."""

_FLANGE_ERROR = 2e-3
"""How far the URDF may have the flange from where the robot has it, m and rad."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Connection:
    """Where a robot is, and whose time counts."""

    robot_ip: str = text("address of the robot")
    clock: str = text(
        "real_time: by the wall clock; lockstep: each period waits for its command",
        default="real_time",
        choices=("real_time", "lockstep"),
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class SimulationConfiguration(Connection, LimitedRobotConfiguration):
    """Parameters of the simulated robot; arrays of shape (7,) in `joints` order."""

    start_positions: Array = joint_numbers("positions at start and after reset, rad", FINITE)


@dataclass(frozen=True, eq=False, kw_only=True)
class FrankaConfiguration(
    Connection, ControlRate, TorqueConvention, TaskFrames, LimitedRobotConfiguration
):
    """Parameters of the robot's node; arrays of shape (7,) in `joints` order.

    Attributes:
        urdf: text of the URDF.
        model: of the arm.
    """

    real_time: bool = switch(
        "libfranka refuses a kernel without PREEMPT_RT; false for a simulated robot", default=True
    )
    flange_frame: str = text("link that is the flange", default="fr3_link8")
    command_timeout: int = whole_number(
        "control periods for which the last command is held; then the robot stops itself",
        Range(1, 1000),
        default=5,
    )
    acceleration_min: Array = joint_numbers("lower acceleration limits, rad/s^2", NEGATIVE)
    acceleration_max: Array = joint_numbers("upper acceleration limits, rad/s^2", POSITIVE)
    torque_rate_max: Array = joint_numbers(
        "limits of the torque rate, N m/s; those of libfranka if empty",
        above(0.0, TORQUE_RATE),
        default=(),
        if_empty=TORQUE_RATE,
    )
    collision_torque: Array = numbers(
        "external torques at which the robot stops, N m",
        POSITIVE,
        length=JOINTS,
        default=(20.0,) * JOINTS,
    )
    collision_force: Array = numbers(
        "external forces, N, and torques, N m, at the hand at which it stops",
        POSITIVE,
        length=6,
        default=(20.0, 20.0, 20.0, 25.0, 25.0, 25.0),
    )
    urdf: str = field(init=False)
    model: pin.Model = field(init=False)

    def __post_init__(self) -> None:
        """Check what concerns several parameters, and read the URDF."""
        super().__post_init__()
        if len(self.joints) != JOINTS:
            raise SettingError("joints", self.joints, f"the {JOINTS} joints of the arm")
        if self.rate_hz != RATE:
            raise SettingError("rate_hz", self.rate_hz, f"{RATE:g}, that of libfranka")
        object.__setattr__(self, "urdf", self.read_urdf())
        object.__setattr__(self, "model", load_model(self, self.urdf))
        for name, frame in (
            ("end_effector_frame", self.end_effectors[0]),
            ("flange_frame", self.flange_frame),
        ):
            try:
                moved_by = self.model.frames[frame_id(self.model, frame)].parentJoint
            except RobotDescriptionError as error:
                raise SettingError(name, frame, f"a link of the URDF ({error})") from error
            if moved_by != JOINTS:
                raise SettingError(name, frame, f"a link that {self.joints[-1]} moves")

    @property
    def end_effector(self) -> pin.SE3:
        """Pose of the end effector's frame in that of the flange."""
        flange, hand = (
            self.model.frames[frame_id(self.model, name)].placement
            for name in (self.flange_frame, self.end_effectors[0])
        )
        return flange.actInv(hand)


def make_drive(config: FrankaConfiguration) -> Drive:
    """Return the law of the drives.

    Raises:
        SettingError: limits that a control period is too long for.
    """
    try:
        return Drive(
            config.model.copy(),
            limits_of(config),
            config.torque_max,
            config.torque_rate_max,
            config.dt,
            config.command_includes_gravity,
            config.effort_includes_gravity,
        )
    except JointLimitsError as error:
        allowed = f"limits that can be kept in steps of {config.dt:g} s ({error})"
        raise SettingError("acceleration_max", config.acceleration_max, allowed) from error


def check_flange(config: FrankaConfiguration, q: Array, flange: pin.SE3) -> None:
    """Check that the URDF is one of the robot.

    Args:
        config: with the URDF.
        q: positions of the joints, shape (7,), rad.
        flange: pose that the robot reports for them, in its base.

    Raises:
        SettingError: it has the flange elsewhere.
    """
    model, data = config.model, config.model.createData()
    pin.framesForwardKinematics(model, data, q)
    base = model.frames[frame_id(model, config.joints[0])].parentFrame
    found = data.oMf[base].actInv(data.oMf[frame_id(model, config.flange_frame)])
    apart = pin.log6(found.actInv(flange)).vector
    if np.abs(apart).max() > _FLANGE_ERROR:
        shown = (" ".join(f"{x:.3f}" for x in each.translation) for each in (found, flange))
        allowed = "the robot's: this one has {} at {} m, the robot at {} m, or turned".format(
            config.flange_frame, *shown
        )
        raise SettingError("robot_description", config.robot_description, allowed)
