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
from viability_bounds_pkg.joint_limits import JointLimits, JointLimitsError
from viability_bounds_pkg.ros.parameters import (
    Parameter,
    joint_names,
    per_joint,
    positive,
)
from viability_bounds_pkg.ros.robot_parameters import ROBOT_TABLE, all_positive
from viability_bounds_pkg.state_dependent.limits import StateDependentBounds
from viability_bounds_pkg.torque_margin import TorqueMargins, tightened, torque_margins

RIVALS = {
    "naive": baselines.naive_bounds,
    "decre": baselines.decre_bounds,
    "rubrecht": baselines.rubrecht_bounds,
}
"""Methods to compare with that need no settings of their own."""

METHODS = ("exact", *RIVALS, "damper")
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
    Parameter("velocity_max", list[float], "speed limits, rad/s"),
    Parameter("acceleration_min", list[float], "lower acceleration limits, rad/s^2, < 0"),
    Parameter("acceleration_max", list[float], "upper acceleration limits, rad/s^2, > 0"),
    Parameter(
        "acceleration_drift",
        list[float],
        "how fast the acceleration changes while a torque is held, rad/s^3; the bounds keep "
        "back what follows from it at this rate",
        default=np.zeros(0),
    ),
    Parameter(
        "acceleration_disturbance",
        list[float],
        "how much more than commanded the joints may accelerate by what no model knows, friction, "
        "payloads, pushes, rad/s^2; kept back from the braking and from the bounds",
        default=np.zeros(0),
    ),
    Parameter(
        "position_margin",
        float,
        "how much further inside the position limits to keep the joints, rad: what the robot or "
        "its sensors may be off",
        default=0.0,
    ),
    Parameter("rate_hz", float, "rate of the control loop, Hz"),
    Parameter(
        "bounds_dt_factor",
        float,
        "horizon of the bounds in control periods; 2 takes the chatter out",
        default=2.0,
        live=True,
    ),
    Parameter(
        "acceleration_limits",
        str,
        "for method exact: worst_case, or state_dependent, which exceeds the limits above where "
        "the torque limits allow it; needs robot_description and torque_max",
        default="worst_case",
    ),
    Parameter(
        "acceleration_peak",
        list[float],
        f"what state_dependent never exceeds, rad/s^2; {PEAK:g} times the limits above if empty",
        default=np.zeros(0),
    ),
    Parameter("method", str, f"one of: {', '.join(METHODS)}", default="exact", live=True),
    Parameter(
        "damper_influence",
        float,
        "for method damper: distance to a limit from which on it acts, rad",
        default=0.2,
    ),
    Parameter("damper_gain", float, "for method damper: speed allowed there, rad/s", default=1.0),
    Parameter(
        "state_timeout", float, "silence after which older stamps are taken again, s", default=0.5
    ),
)

PARAMETER_OF = {
    "names": "joints",
    "q_min": "position_min",
    "q_max": "position_max",
    "v_max": "velocity_max",
    "a_min": "acceleration_min",
    "a_max": "acceleration_max",
    "margin": "acceleration_drift",
    "dt": "bounds_dt_factor",
    "period": "rate_hz",
    "peak": "acceleration_peak",
    "tau_max": "torque_max",
}


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
    solve: Callable[[NDArray, NDArray], viability.AccelerationBounds]
    state_dependent: StateDependentBounds | None
    """Whose method `solve` is, with state-dependent limits."""


def make_configuration(
    values: Mapping[str, Any], load_model: Callable[[Mapping[str, Any]], pin.Model]
) -> BoundsConfiguration:
    """Check parameter values and make what the node runs on of them.

    Args:
        values: parameter values by name.
        load_model: returns the arm's model, asked for only where it is needed.

    Raises:
        SettingError: one of them cannot be used.
    """
    joints = joint_names(values)
    if values["method"] not in METHODS:
        raise SettingError("method", values["method"], f"one of {', '.join(METHODS)}")
    if values["acceleration_limits"] not in LIMITS:
        allowed = f"one of {', '.join(LIMITS)}"
        raise SettingError("acceleration_limits", values["acceleration_limits"], allowed)
    dt = 1.0 / positive(values, "rate_hz")
    factor = positive(values, "bounds_dt_factor")
    if factor < 1.0:
        raise SettingError("bounds_dt_factor", factor, ">= 1")
    try:
        limits = JointLimits(
            joints,
            *(
                per_joint(values, PARAMETER_OF[field], joints)
                for field in ("q_min", "q_max", "v_max", "a_min", "a_max")
            ),
        )
        margins = _margins(values, limits, dt)
        method = values["method"]
        state_dependent = None
        if method == "exact" and values["acceleration_limits"] == "state_dependent":
            state_dependent = _state_dependent(values, load_model, limits, margins, factor, dt)
            solve = state_dependent.bounds
        elif method == "exact":
            inner = tightened(limits, margins)
            solver = viability.BoundsSolver(inner, factor * dt, margins.acceleration, period=dt)
            solve = solver.bounds
        elif method == "damper":
            solve = partial(
                baselines.damper_bounds,
                limits=limits,
                dt=factor * dt,
                influence=positive(values, "damper_influence"),
                gain=positive(values, "damper_gain"),
            )
        else:
            solve = partial(RIVALS[method], limits=limits, dt=factor * dt)
    except JointLimitsError as error:
        name = PARAMETER_OF[error.field]
        shown = error.value if error.joint is None else f"{error.value} for {error.joint}"
        raise SettingError(name, shown, error.allowed) from error
    return BoundsConfiguration(
        limits=limits,
        margins=margins,
        control_dt=dt,
        bounds_dt=factor * dt,
        method=values["method"],
        state_timeout=positive(values, "state_timeout"),
        solve=solve,
        state_dependent=state_dependent,
    )


def _state_dependent(
    values: Mapping[str, Any],
    load_model: Callable[[Mapping[str, Any]], pin.Model],
    limits: JointLimits,
    margins: TorqueMargins,
    factor: float,
    dt: float,
) -> StateDependentBounds:
    if not values["robot_description"]:
        allowed = "a URDF, for state-dependent acceleration limits"
        raise SettingError("robot_description", values["robot_description"], allowed)
    peak = PEAK * np.maximum(-limits.a_min, limits.a_max)
    if len(values["acceleration_peak"]):
        peak = per_joint(values, "acceleration_peak", limits.names)
    return StateDependentBounds(
        load_model(values),
        tightened(limits, margins),
        all_positive(values, "torque_max", limits.names),
        peak,
        factor * dt,
        margins.acceleration,
        dt,
        margins.position,
    )


def _not_negative(values: Mapping[str, Any], name: str, limits: JointLimits) -> np.ndarray:
    """Return a parameter of one number a joint, shape (n,), zeros if it is empty."""
    if not len(values[name]):
        return np.zeros(len(limits))
    value = per_joint(values, name, limits.names)
    if not (np.isfinite(value).all() and (value >= 0.0).all()):
        raise SettingError(name, value, "finite numbers >= 0")
    return value


def _margins(values: Mapping[str, Any], limits: JointLimits, dt: float) -> TorqueMargins:
    """Return what to keep back for the drift of acceleration and for the robot itself."""
    margins = torque_margins(_not_negative(values, "acceleration_drift", limits), dt)
    disturbance = _not_negative(values, "acceleration_disturbance", limits)
    margins.acceleration[:] += disturbance
    braking = np.minimum(-limits.a_min, limits.a_max)
    if not (margins.acceleration < braking).all():
        name = "acceleration_disturbance" if disturbance.any() else "acceleration_drift"
        allowed = f"less than what there is to brake with, {braking}, by the margins for the rate"
        raise SettingError(name, values[name], allowed)
    margins.position[:] += positive(values, "position_margin", zero=True)
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
