"""The robot node's parameters: the table, and their checks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from viability_bounds_pkg.ros_parameters import (
    Parameter,
    ParameterError,
    joint_names,
    per_joint,
    positive,
)
from viability_bounds_pkg.ros_robot_parameters import (
    ROBOT_TABLE,
    all_positive,
    locked_joints,
    position_limits,
    robot_urdf,
)

CLOCKS = ("real_time", "lockstep")

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
        "external_wrench_timeout", float, "how long a push lasts, s of robot time", default=0.5
    ),
)


@dataclass(frozen=True)
class BulletConfiguration:
    """Checked parameters of the robot node; arrays of shape (n,) in `joints` order."""

    urdf: str
    joints: tuple[str, ...]
    locked: dict[str, float]
    q_min: np.ndarray
    q_max: np.ndarray
    v_max: np.ndarray
    tau_max: np.ndarray
    q_start: np.ndarray
    dt: float
    substeps: int
    lockstep: bool
    command_timeout: int
    start_paused: bool
    pause_after: float
    publish_clock: bool
    external_wrench_timeout: float


def make_configuration(values: Mapping[str, Any]) -> BulletConfiguration:
    """Check parameter values and read the URDF.

    Raises:
        ParameterError: a value cannot be used.
    """
    joints = joint_names(values)
    urdf = robot_urdf(values)
    if values["clock"] not in CLOCKS:
        raise ParameterError("clock", values["clock"], f"one of {', '.join(CLOCKS)}")
    if values["command_timeout"] < 1:
        raise ParameterError("command_timeout", values["command_timeout"], "at least 1")
    dt = 1.0 / positive(values, "rate_hz")
    q_min, q_max = position_limits(values, joints)
    q_start = per_joint(values, "start_positions", joints)
    if not np.isfinite(q_start).all():
        raise ParameterError("start_positions", q_start, "finite numbers")
    return BulletConfiguration(
        urdf=urdf,
        joints=joints,
        locked=locked_joints(values),
        q_min=q_min,
        q_max=q_max,
        v_max=all_positive(values, "velocity_max", joints),
        tau_max=all_positive(values, "torque_max", joints),
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
    )
