# SPDX-License-Identifier: Apache-2.0
"""The bounds node's parameters, and the bounds that it computes by them."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from functools import cached_property, lru_cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from viability_bounds_pkg import baselines, viability
from viability_bounds_pkg.bounds.jerk import JerkBoundsSolver
from viability_bounds_pkg.bounds.torque_margin import TorqueMargins, tightened, torque_margins
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
from viability_bounds_pkg.robot.gravity import TorqueConvention
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
}
"""Methods to compare with."""

METHODS = ("exact", *BASELINES)


def limits_of(
    config: Any, clearance: Array | float = 0.0, accelerations: Any = None
) -> JointLimits:
    """Return the limits in a configuration that has these fields of `BoundsConfiguration`.

    Args:
        config: the configuration.
        clearance: distance to keep from the position limits, shape (n,), rad.
        accelerations: what has the limits of accelerations; None for `config`.
    """
    accelerations = accelerations or config
    return JointLimits(
        config.joints,
        config.position_min + clearance,
        config.position_max - clearance,
        config.velocity_max,
        accelerations.acceleration_min,
        accelerations.acceleration_max,
        config.velocity_offset,
        config.deceleration_limit,
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class BoundsConfiguration(VelocityEstimation, StateSource, ControlRate, LimitedRobotConfiguration):
    """Parameters of the bounds node; the torque limits are empty where none are needed."""

    robot_description: str = redeclared(RobotConfiguration, "robot_description", default="")
    NOT_NEEDED = frozenset({"torque_max"})
    effort_includes_gravity: bool = redeclared(TorqueConvention, "effort_includes_gravity")
    acceleration_min: Array = joint_numbers("lower acceleration limits, rad/s^2", NEGATIVE)
    acceleration_max: Array = joint_numbers("upper acceleration limits, rad/s^2", POSITIVE)
    acceleration_drift: Array = joint_amounts(
        "largest jerk under a held torque, for which the bounds keep a margin, rad/s^3; 0 if empty"
    )
    jerk_max: Array = joint_numbers(
        "largest change of the commanded accelerations from one control period to the next, "
        "divided by the period, rad/s^3; no limit if empty",
        POSITIVE,
        default=(),
    )
    declared: DeclaredUncertainty = group(DeclaredUncertainty)
    position_margin: float = number(
        "distance to keep from the position limits, rad",
        Range(0.0, 1.0),
        default=0.0,
    )
    bounds_dt_factor: float = number(
        "horizon of the bounds in control periods; longer if missed deadlines are declared; 2 "
        "avoids chatter",
        Range(1.0, 1e3),
        default=2.0,
        live=True,
    )
    method: str = text(
        "exact keeps the limits; the others are for comparison",
        default="exact",
        live=True,
        choices=METHODS,
    )
    state_timeout: float = timeout(
        "silence after which older stamps are accepted again, s", default=0.5
    )

    def __post_init__(self) -> None:
        """Check also that all that is declared is known to go with a limit of the jerk."""
        super().__post_init__()
        if not len(self.jerk_max):
            return
        declared = self.declared
        excluded = {
            **{each.name: np.any(getattr(declared, each.name)) for each in fields(declared)},
            "use_estimated_states": self.use_estimated_states,
            "method": self.method != "exact",
        }
        for name in ("acceleration_disturbance", "lasting_disturbance"):
            del excluded[name]
        for name, given in excluded.items():
            if given:
                allowed = f"none where '{name}' is given: no limit is promised with both"
                raise SettingError("jerk_max", self.jerk_max, allowed)

    @cached_property
    def limits(self) -> JointLimits:
        """Limits of the joints."""
        return limits_of(self)

    @cached_property
    def uncertainty(self) -> UncertaintyMargins:
        """What the bounds hold for, by what is declared."""
        return self.loop.margins(self.declared)

    @property
    def horizon(self) -> float:
        """How long an acceleration is assumed to last, s."""
        return self.uncertainty.horizon

    @property
    def margins(self) -> TorqueMargins:
        """What the exact bounds keep back from the limits."""
        margins = self.loop.torque_margins.held(self.declared.periods_held)
        disturbed = margins.acceleration + self.declared.acceleration_disturbance
        return margins._replace(acceleration=disturbed)

    @property
    def loop(self) -> Loop:
        """The control loop that the bounds are for."""
        margins = torque_margins(self.acceleration_drift, self.dt)
        return Loop(
            self.limits,
            margins._replace(position=margins.position + self.position_margin),
            self.dt,
            self.bounds_dt_factor * self.dt,
            self.use_estimated_states,
            self.use_estimated_states and self.velocity_estimation,
        )


Bounds = Callable[[Array, Array], viability.AccelerationBounds]
"""Computes the bounds from positions and velocities."""


@lru_cache(maxsize=1)
def make_solver(config: BoundsConfiguration) -> viability.BoundsSolver:
    """Return the exact bounds, the same ones again for the same configuration.

    Raises:
        SettingError: declarations, or a control rate, that leave no bounds.
    """
    try:
        return config.loop.bounds(config.declared)
    except JointLimitsError as error:
        raise _cause(config, error) from error


def _cause(config: BoundsConfiguration, error: JointLimitsError) -> SettingError:
    """Return the error that names the first setting without which there were bounds."""
    declared = config.declared
    without = {
        each.name: replace(config, declared=replace(declared, **{each.name: 0 * value}))
        for each in fields(declared)
        if np.any(value := getattr(declared, each.name))
    }
    for name in ("acceleration_drift", "position_margin"):
        without[name] = replace(config, **{name: 0 * getattr(config, name)})
    for name, less in without.items():
        with suppress(JointLimitsError):
            less.loop.bounds(less.declared)
            value = getattr(declared, name, getattr(config, name, None))
            wanted = "more" if name == "motor_bandwidth" else "less"
            return SettingError(name, value, f"{wanted} at {config.rate_hz:g} Hz ({error})")
    return SettingError("rate_hz", config.rate_hz, f"what leaves bounds ({error})")


def make_bounds(config: BoundsConfiguration) -> Bounds:
    """Return how the bounds are computed.

    Raises:
        SettingError: declarations that leave no bounds.
    """
    if config.method == "exact":
        return make_solver(config).bounds
    return partial(BASELINES[config.method], limits=config.limits, dt=config.horizon)


def make_jerk_solver(config: BoundsConfiguration) -> JerkBoundsSolver:
    """Return the bounds of the jerk that is configured.

    Raises:
        SettingError: it leaves no bounds.
    """
    margins = config.loop.torque_margins
    margin = margins.with_jerk + config.declared.acceleration_disturbance
    try:
        return JerkBoundsSolver(
            tightened(config.limits, margins), config.jerk_max, config.dt, config.horizon, margin
        )
    except JointLimitsError as error:
        allowed = f"what leaves bounds at {config.rate_hz:g} Hz ({error})"
        raise SettingError("jerk_max", config.jerk_max, allowed) from error


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
