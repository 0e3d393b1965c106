# SPDX-License-Identifier: Apache-2.0
"""The bounds node's parameters: the table, and what the node computes with from it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from viability_bounds_pkg import baselines, viability
from viability_bounds_pkg.exceptions import SettingError
from viability_bounds_pkg.joint_limits import JointLimits
from viability_bounds_pkg.ros.parameters import (
    NEGATIVE,
    NOT_NEGATIVE,
    POSITIVE,
    Parameter,
    Range,
    above,
    given_or,
    joint_names,
    per_joint,
)
from viability_bounds_pkg.ros.robot_parameters import (
    ROBOT_TABLE,
    RobotConfiguration,
    position_limits,
    robot_configuration,
)
from viability_bounds_pkg.state_dependent.limits import StateDependentBounds
from viability_bounds_pkg.torque_margin import TorqueMargins, tightened, torque_margins

Array = NDArray[np.float64]

BASELINES = {
    "naive": baselines.naive_bounds,
    "decre": baselines.decre_bounds,
    "rubrecht": baselines.rubrecht_bounds,
}
"""Methods to compare with that need no settings of their own."""

METHODS = ("exact", *BASELINES, "damper")
LIMITS = ("worst_case", "state_dependent")
PEAK = 3.0
"""Default of ``acceleration_peak``, in limits of the worst case."""

_OPTIONAL = {"robot_description": "", "torque_max": np.zeros(0)}
"""Of the robot, what only state-dependent limits need."""

TABLE = (
    *(
        replace(row, default=_OPTIONAL[row.name]) if row.name in _OPTIONAL else row
        for row in ROBOT_TABLE
    ),
    Parameter("velocity_max", list[float], "speed limits, rad/s", per_joint=True, within=POSITIVE),
    Parameter(
        "acceleration_min",
        list[float],
        "lower acceleration limits, rad/s^2",
        per_joint=True,
        within=NEGATIVE,
    ),
    Parameter(
        "acceleration_max",
        list[float],
        "upper acceleration limits, rad/s^2",
        per_joint=True,
        within=POSITIVE,
    ),
    Parameter(
        "acceleration_drift",
        list[float],
        "largest jerk under held torque, rad/s^3; the bounds are tightened by the error that it "
        "causes within a control period; 0 if empty",
        default=np.zeros(0),
        per_joint=True,
        within=NOT_NEGATIVE,
    ),
    Parameter(
        "acceleration_disturbance",
        list[float],
        "how much more than commanded the joints may accelerate by what the model does not know, "
        "friction, payloads, pushes, rad/s^2; the bounds are tightened by it; 0 if empty",
        default=np.zeros(0),
        per_joint=True,
        within=NOT_NEGATIVE,
    ),
    Parameter(
        "position_margin",
        float,
        "how much further inside the position limits to keep the joints, rad: what the robot or "
        "its sensors may be off",
        default=0.0,
        within=Range(0.0, 1.0),
    ),
    Parameter("rate_hz", float, "rate of the control loop, Hz", within=above(0.0, 1e4)),
    Parameter(
        "bounds_dt_factor",
        float,
        "horizon of the bounds in control periods; 2 avoids chatter",
        default=2.0,
        live=True,
        within=Range(1.0, 1e3),
    ),
    Parameter(
        "acceleration_limits",
        str,
        "for method exact: worst_case, or state_dependent, which exceeds the limits above where "
        "the torque limits allow it; needs robot_description and torque_max",
        default="worst_case",
        choices=LIMITS,
    ),
    Parameter(
        "acceleration_peak",
        list[float],
        f"largest acceleration that state_dependent allows, rad/s^2; {PEAK:g} times the limits "
        "above if empty",
        default=np.zeros(0),
        per_joint=True,
        within=POSITIVE,
    ),
    Parameter(
        "method",
        str,
        "how bounds are computed: exact keeps the limits; the others are for comparison",
        default="exact",
        live=True,
        choices=METHODS,
    ),
    Parameter(
        "damper_influence",
        float,
        "for method damper: distance to a limit from which on it acts, rad",
        default=0.2,
        within=above(0.0, 10.0),
    ),
    Parameter(
        "damper_gain",
        float,
        "for method damper: speed allowed there, rad/s",
        default=1.0,
        within=above(0.0, 1e3),
    ),
    Parameter(
        "state_timeout",
        float,
        "silence after which older stamps are accepted again, s",
        default=0.5,
        within=above(0.0, 3600.0),
    ),
)


@dataclass(frozen=True)
class BoundsConfiguration:
    """Checked parameters of the bounds node."""

    limits: JointLimits
    margins: TorqueMargins
    """What the exact bounds keep back."""
    control_dt: float
    bounds_dt: float
    method: str
    state_timeout: float
    solve: Callable[[Array, Array], viability.AccelerationBounds]
    state_dependent: StateDependentBounds | None
    """Whose method `solve` is, with state-dependent limits."""


def make_configuration(
    values: Mapping[str, Any], load_model: Callable[[RobotConfiguration], pin.Model]
) -> BoundsConfiguration:
    """Check parameter values and make what the node runs on of them.

    Args:
        values: of `TABLE`, by name, as `read_values` returns them.
        load_model: returns the arm's model, asked for only where it is needed.

    Raises:
        SettingError: values that do not fit together.
    """
    joints = joint_names(values)
    dt = 1.0 / values["rate_hz"]
    horizon = values["bounds_dt_factor"] * dt
    q_min, q_max = position_limits(values, joints)
    limits = JointLimits(
        joints,
        q_min,
        q_max,
        values["velocity_max"],
        values["acceleration_min"],
        values["acceleration_max"],
    )
    margins = _margins(values, limits, dt)
    method = values["method"]
    state_dependent = None
    solve: Callable[[Array, Array], viability.AccelerationBounds]
    if method == "exact" and values["acceleration_limits"] == "state_dependent":
        state_dependent = _state_dependent(values, load_model, limits, margins, horizon, dt)
        solve = state_dependent.bounds
    elif method == "exact":
        inner = tightened(limits, margins)
        solve = viability.BoundsSolver(inner, horizon, margins.acceleration, period=dt).bounds
    elif method == "damper":
        solve = partial(
            baselines.damper_bounds,
            limits=limits,
            dt=horizon,
            influence=values["damper_influence"],
            gain=values["damper_gain"],
        )
    else:
        solve = partial(BASELINES[method], limits=limits, dt=horizon)
    return BoundsConfiguration(
        limits=limits,
        margins=margins,
        control_dt=dt,
        bounds_dt=horizon,
        method=method,
        state_timeout=values["state_timeout"],
        solve=solve,
        state_dependent=state_dependent,
    )


def _state_dependent(
    values: Mapping[str, Any],
    load_model: Callable[[RobotConfiguration], pin.Model],
    limits: JointLimits,
    margins: TorqueMargins,
    horizon: float,
    dt: float,
) -> StateDependentBounds:
    if not values["robot_description"]:
        allowed = "a URDF, for state-dependent acceleration limits"
        raise SettingError("robot_description", values["robot_description"], allowed)
    worst = np.maximum(-limits.a_min, limits.a_max)
    peak = given_or(values, "acceleration_peak", PEAK * worst)
    if (peak < worst).any():
        allowed = f"at least that of the worst case, {worst}"
        raise SettingError("acceleration_peak", peak, allowed)
    return StateDependentBounds(
        load_model(robot_configuration(values)),
        tightened(limits, margins),
        per_joint(values, "torque_max", limits.names),
        peak,
        horizon,
        margins.acceleration,
        dt,
        margins.position,
    )


def _margins(values: Mapping[str, Any], limits: JointLimits, dt: float) -> TorqueMargins:
    """Return what to keep back for the drift of acceleration and for the robot itself."""
    zero = np.zeros(len(limits))
    margins = torque_margins(given_or(values, "acceleration_drift", zero), dt)
    disturbance = given_or(values, "acceleration_disturbance", zero)
    margins.acceleration[:] += disturbance
    braking = np.minimum(-limits.a_min, limits.a_max)
    if not (margins.acceleration < braking).all():
        name = "acceleration_disturbance" if disturbance.any() else "acceleration_drift"
        allowed = f"less than what there is to brake with, {braking}, by the margins for the rate"
        raise SettingError(name, values[name], allowed)
    margins.position[:] += values["position_margin"]
    for name, margin, room in (
        ("velocity_max", margins.velocity, limits.v_max),
        ("position_max", margins.position, 0.5 * (limits.q_max - limits.q_min)),
    ):
        if not (margin < room).all():
            raise SettingError(
                name,
                values[name],
                f"more than the margins for acceleration_drift at this rate take: {margin}",
            )
    return margins
