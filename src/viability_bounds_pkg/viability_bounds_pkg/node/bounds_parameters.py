# SPDX-License-Identifier: Apache-2.0
"""The bounds node's parameters, and the bounds that it computes by them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from viability_bounds_pkg import baselines, viability
from viability_bounds_pkg.exceptions import SettingError
from viability_bounds_pkg.joint_limits import JointLimits
from viability_bounds_pkg.parameter import (
    NEGATIVE,
    NOT_NEGATIVE,
    POSITIVE,
    Range,
    above,
    check_per_joint,
    joint_numbers,
    number,
    redeclared,
    text,
)
from viability_bounds_pkg.robot_configuration import (
    ControlRate,
    LimitedRobotConfiguration,
    RobotConfiguration,
)
from viability_bounds_pkg.state_dependent.limits import StateDependentBounds
from viability_bounds_pkg.torque_margin import TorqueMargins, tightened, torque_margins

Array = NDArray[np.float64]

BASELINES = {
    "naive": baselines.naive_bounds,
    "decre": baselines.decre_bounds,
    "rubrecht": baselines.rubrecht_bounds,
    "damper": baselines.damper_bounds,
}
"""Methods to compare with."""

METHODS = ("exact", *BASELINES)
LIMITS = ("worst_case", "state_dependent")
PEAK = 3.0
"""Default of ``acceleration_peak``, in limits of the worst case."""


@dataclass(frozen=True, eq=False, kw_only=True)
class BoundsConfiguration(ControlRate, LimitedRobotConfiguration):
    """Parameters of the bounds node; the torque limits are empty where none are needed.

    Attributes:
        limits: of the joints.
        margins: what the exact bounds keep back.
    """

    robot_description: str = redeclared(RobotConfiguration, "robot_description", default="")
    torque_max: Array = redeclared(RobotConfiguration, "torque_max", default=())
    acceleration_min: Array = joint_numbers("lower acceleration limits, rad/s^2", NEGATIVE)
    acceleration_max: Array = joint_numbers("upper acceleration limits, rad/s^2", POSITIVE)
    acceleration_drift: Array = joint_numbers(
        "largest jerk under held torque, rad/s^3; the bounds are tightened by the error that it "
        "causes within a control period; 0 if empty",
        NOT_NEGATIVE,
        if_empty=0.0,
    )
    acceleration_disturbance: Array = joint_numbers(
        "how much more than commanded the joints may accelerate by what the model does not know, "
        "friction, payloads, pushes, rad/s^2; the bounds are tightened by it; 0 if empty",
        NOT_NEGATIVE,
        if_empty=0.0,
    )
    position_margin: float = number(
        "how much further inside the position limits to keep the joints, rad: what the robot or "
        "its sensors may be off",
        Range(0.0, 1.0),
        default=0.0,
    )
    bounds_dt_factor: float = number(
        "horizon of the bounds in control periods; 2 avoids chatter",
        Range(1.0, 1e3),
        default=2.0,
        live=True,
    )
    acceleration_limits: str = text(
        "for method exact: worst_case, or state_dependent, which exceeds the limits above where "
        "the torque limits allow it; needs robot_description and torque_max",
        default="worst_case",
        choices=LIMITS,
    )
    acceleration_peak: Array = joint_numbers(
        f"largest acceleration that state_dependent allows, rad/s^2; {PEAK:g} times the limits "
        "above if empty",
        POSITIVE,
        default=(),
    )
    method: str = text(
        "how bounds are computed: exact keeps the limits; the others are for comparison",
        default="exact",
        live=True,
        choices=METHODS,
    )
    damper_influence: float = number(
        "for method damper: distance to a limit from which on it acts, rad",
        above(0.0, 10.0),
        default=0.2,
    )
    damper_gain: float = number(
        "for method damper: speed allowed there, rad/s", above(0.0, 1e3), default=1.0
    )
    state_timeout: float = number(
        "silence after which older stamps are accepted again, s", above(0.0, 3600.0), default=0.5
    )
    limits: JointLimits = field(init=False)
    margins: TorqueMargins = field(init=False)

    def __post_init__(self) -> None:
        """Make limits and margins, which must leave something to move with."""
        super().__post_init__()
        limits = JointLimits(
            self.joints,
            self.position_min,
            self.position_max,
            self.velocity_max,
            self.acceleration_min,
            self.acceleration_max,
        )
        object.__setattr__(self, "limits", limits)
        object.__setattr__(self, "margins", self._margins(limits))

    @property
    def horizon(self) -> float:
        """How long an acceleration is assumed to last, s."""
        return self.bounds_dt_factor * self.dt

    def _margins(self, limits: JointLimits) -> TorqueMargins:
        margins = torque_margins(self.acceleration_drift, self.dt)
        disturbance = self.acceleration_disturbance
        margins.acceleration[:] += disturbance
        braking = np.minimum(-limits.a_min, limits.a_max)
        if not (margins.acceleration < braking).all():
            name = "acceleration_disturbance" if disturbance.any() else "acceleration_drift"
            allowed = (
                f"less than what there is to brake with, {braking}, by the margins for the rate"
            )
            raise SettingError(name, getattr(self, name), allowed)
        margins.position[:] += self.position_margin
        for name, margin, room in (
            ("velocity_max", margins.velocity, limits.v_max),
            ("position_max", margins.position, 0.5 * (limits.q_max - limits.q_min)),
        ):
            if not (margin < room).all():
                raise SettingError(
                    name,
                    getattr(self, name),
                    f"more than the margins for acceleration_drift at this rate take: {margin}",
                )
        return margins


class Bounds(NamedTuple):
    """How the bounds are computed.

    Attributes:
        solve: from positions and velocities.
        state_dependent: whose method `solve` is, with state-dependent limits.
    """

    solve: Callable[[Array, Array], viability.AccelerationBounds]
    state_dependent: StateDependentBounds | None = None


def make_bounds(
    config: BoundsConfiguration, load_model: Callable[[RobotConfiguration], pin.Model]
) -> Bounds:
    """Return how the bounds are computed.

    Args:
        config: parameters of the node.
        load_model: returns the arm's model, asked for only where it is needed.

    Raises:
        SettingError: state-dependent limits without what they need.
    """
    limits, margins, horizon = config.limits, config.margins, config.horizon
    if config.method == "exact" and config.acceleration_limits == "state_dependent":
        state_dependent = _state_dependent(config, load_model)
        return Bounds(state_dependent.bounds, state_dependent)
    if config.method == "exact":
        inner = tightened(limits, margins)
        solver = viability.BoundsSolver(inner, horizon, margins.acceleration, period=config.dt)
        return Bounds(solver.bounds)
    own = {"influence": config.damper_influence, "gain": config.damper_gain}
    settings = own if config.method == "damper" else {}
    return Bounds(partial(BASELINES[config.method], limits=limits, dt=horizon, **settings))


def _state_dependent(
    config: BoundsConfiguration, load_model: Callable[[RobotConfiguration], pin.Model]
) -> StateDependentBounds:
    limits, margins = config.limits, config.margins
    if not config.robot_description:
        allowed = "a URDF, for state-dependent acceleration limits"
        raise SettingError("robot_description", config.robot_description, allowed)
    worst = np.maximum(-limits.a_min, limits.a_max)
    peak = config.acceleration_peak if len(config.acceleration_peak) else PEAK * worst
    if (peak < worst).any():
        allowed = f"at least that of the worst case, {worst}"
        raise SettingError("acceleration_peak", peak, allowed)
    check_per_joint("torque_max", config.torque_max, limits.names)
    return StateDependentBounds(
        load_model(config),
        tightened(limits, margins),
        config.torque_max,
        peak,
        config.horizon,
        margins.acceleration,
        config.dt,
        margins.position,
    )
