# SPDX-License-Identifier: Apache-2.0
"""The bounds node's parameters, and the bounds that it computes by them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from viability_bounds_pkg import baselines, viability
from viability_bounds_pkg.bounds.torque_margin import TorqueMargins, torque_margins
from viability_bounds_pkg.exceptions import SettingError
from viability_bounds_pkg.joint_limits import JointLimits, JointLimitsError
from viability_bounds_pkg.parameter import (
    NEGATIVE,
    POSITIVE,
    Range,
    group,
    joint_amounts,
    joint_numbers,
    number,
    redeclared,
    text,
    timeout,
)
from viability_bounds_pkg.plausible import PlausibilityCheck
from viability_bounds_pkg.robot.configuration import (
    ControlRate,
    LimitedRobotConfiguration,
    RobotConfiguration,
    StateSource,
)
from viability_bounds_pkg.uncertainty import (
    DeclaredUncertainty,
    Loop,
    UncertaintyMargins,
    VelocityEstimation,
)

Array = NDArray[np.float64]

BASELINES = {
    "naive": baselines.naive_bounds,
    "decre": baselines.decre_bounds,
    "rubrecht": baselines.rubrecht_bounds,
    "damper": baselines.damper_bounds,
}
"""Methods to compare with."""

METHODS = ("exact", *BASELINES)


def limits_of(config: Any) -> JointLimits:
    """Return the limits in a configuration that has these fields of `BoundsConfiguration`."""
    return JointLimits(
        config.joints,
        config.position_min,
        config.position_max,
        config.velocity_max,
        config.acceleration_min,
        config.acceleration_max,
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class BoundsConfiguration(VelocityEstimation, StateSource, ControlRate, LimitedRobotConfiguration):
    """Parameters of the bounds node; the torque limits are empty where none are needed.

    Attributes:
        limits: of the joints.
        margins: what the exact bounds keep back.
        uncertainty: what else they hold for, by what is declared.
    """

    robot_description: str = redeclared(RobotConfiguration, "robot_description", default="")
    NOT_NEEDED = frozenset({"torque_max"})
    acceleration_min: Array = joint_numbers("lower acceleration limits, rad/s^2", NEGATIVE)
    acceleration_max: Array = joint_numbers("upper acceleration limits, rad/s^2", POSITIVE)
    acceleration_drift: Array = joint_amounts(
        "largest jerk under held torque, rad/s^3; the bounds are tightened by the error that it "
        "causes within a control period; 0 if empty"
    )
    declared: DeclaredUncertainty = group(DeclaredUncertainty)
    position_margin: float = number(
        "how much further inside the position limits to keep the joints, rad: what the robot or "
        "its sensors may be off",
        Range(0.0, 1.0),
        default=0.0,
    )
    bounds_dt_factor: float = number(
        "horizon of the bounds in control periods, longer where missed deadlines are declared; 2 "
        "avoids chatter",
        Range(1.0, 1e3),
        default=2.0,
        live=True,
    )
    method: str = text(
        "how bounds are computed: exact keeps the limits; the others are for comparison",
        default="exact",
        live=True,
        choices=METHODS,
    )
    state_timeout: float = timeout(
        "silence after which older stamps are accepted again, s", default=0.5
    )
    limits: JointLimits = field(init=False)
    margins: TorqueMargins = field(init=False)
    uncertainty: UncertaintyMargins = field(init=False)

    def __post_init__(self) -> None:
        """Make limits and margins, which must leave something to move with."""
        super().__post_init__()
        limits = limits_of(self)
        object.__setattr__(self, "limits", limits)
        object.__setattr__(self, "margins", self._margins(limits))
        object.__setattr__(self, "uncertainty", self.loop.margins(self.declared))

    @property
    def horizon(self) -> float:
        """How long an acceleration is assumed to last, s."""
        return self.uncertainty.horizon

    @property
    def loop(self) -> Loop:
        """The control loop that the bounds are for."""
        return Loop(
            self.limits,
            self._torque_margins(),
            self.dt,
            self.bounds_dt_factor * self.dt,
            self.use_estimated_states,
            self.use_estimated_states and self.velocity_estimation,
        )

    def _torque_margins(self) -> TorqueMargins:
        margins = torque_margins(self.acceleration_drift, self.dt)
        margins.position[:] += self.position_margin
        return margins

    def _margins(self, limits: JointLimits) -> TorqueMargins:
        margins, disturbance = self._torque_margins(), self.declared.acceleration_disturbance
        margins.acceleration[:] += disturbance
        braking = np.minimum(-limits.a_min, limits.a_max)
        if not (margins.acceleration < braking).all():
            name, value = "acceleration_drift", self.acceleration_drift
            if disturbance.any():
                name, value = "acceleration_disturbance", disturbance
            allowed = (
                f"less than what there is to brake with, {braking}, by the margins for the rate"
            )
            raise SettingError(name, value, allowed)
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


Bounds = Callable[[Array, Array], viability.AccelerationBounds]
"""Computes the bounds from positions and velocities."""


def make_solver(config: BoundsConfiguration) -> viability.BoundsSolver:
    """Return the exact bounds.

    Raises:
        SettingError: declarations, or a control rate, that leave no bounds.
    """
    try:
        return config.loop.bounds(config.declared)
    except JointLimitsError as error:
        found = config.loop.refusal(config.declared, error)
        if not isinstance(found, SettingError):
            found = SettingError("rate_hz", config.rate_hz, f"what leaves bounds: {found}")
        raise found from error


def make_bounds(config: BoundsConfiguration) -> Bounds:
    """Return how the bounds are computed.

    Raises:
        SettingError: declarations that leave no bounds.
    """
    if config.method == "exact":
        return make_solver(config).bounds
    return partial(BASELINES[config.method], limits=config.limits, dt=config.horizon)


def make_plausibility_check(
    config: Any, declared: DeclaredUncertainty | None, uses_velocities: bool = True
) -> PlausibilityCheck:
    """Return the check of the states that the robot reports.

    Args:
        config: has the limits and ``dt`` of `BoundsConfiguration`.
        declared: of the robot's errors; None for none.
        uses_velocities: whether velocities are not estimated.
    """
    none = np.zeros(len(config.joints))
    errors = (none, none)
    if declared is not None:
        errors = declared.position_error, declared.velocity_error
    return PlausibilityCheck(
        config.position_min,
        config.position_max,
        config.velocity_max,
        config.dt,
        errors[0],
        errors[1] if uses_velocities else None,
    )
