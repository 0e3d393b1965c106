# SPDX-License-Identifier: Apache-2.0
"""Declared uncertainty of a robot, and the horizon and errors that its bounds must hold for.

All declarations zero: states are exact, commands act at once. `docs/theory/bounds.md` derives the
rest. The bounds are asked for a state that belongs to the instant when the command begins to act
if it is not late; its error is that of the state for its own instant, what the acceleration may be
off until then, and what other commands than those expected may do.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from viability_bounds_pkg.bounds.torque_margin import TorqueMargins, tightened
from viability_bounds_pkg.joint_limits import JointLimits
from viability_bounds_pkg.parameter import joint_amounts, periods, switch
from viability_bounds_pkg.state import State
from viability_bounds_pkg.state_estimation.observer import ObserverDesign, design_observer
from viability_bounds_pkg.viability import BoundsSolver

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False, kw_only=True)
class VelocityEstimation:
    """Where the velocities in estimated joint states come from."""

    velocity_estimation: bool = switch(
        "estimate velocities from positions and torques; false: use the reported ones",
        default=True,
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class DeclaredUncertainty:
    """Largest errors of states, times and accelerations; arrays of shape (n,)."""

    position_error: Array = joint_amounts(
        "largest error of a reported position (resolution, noise), rad; 0 if empty"
    )
    velocity_error: Array = joint_amounts(
        "largest error of a reported velocity, rad/s; 0 if empty",
        note="not used with use_estimated_states, where the observer's own error counts",
    )
    acceleration_disturbance: Array = joint_amounts(
        "largest difference of true and commanded acceleration (friction, payload, pushes), "
        "which the bounds keep as a margin, rad/s^2; 0 if empty"
    )
    lasting_disturbance: Array = joint_amounts(
        "largest part of it that lasts (friction, wrong masses) and that the estimator may "
        "learn, rad/s^2; 0 if empty"
    )
    delay: int = periods(
        "control periods from the instant of a state until the command for it begins to act"
    )
    delay_jitter: int = periods("control periods by which the delay may sometimes be longer")
    missed_deadlines: int = periods(
        "largest number of consecutive control periods without a new command; the robot keeps "
        "the last one"
    )
    motor_bandwidth: Array = joint_amounts(
        "bandwidth of the motors' torque as a first-order lag, Hz; 0 or empty: no lag"
    )

    @property
    def periods_held(self) -> int:
        """Longest time for which a command may act, in control periods."""
        return 1 + self.delay_jitter + self.missed_deadlines

    @property
    def motor_lag(self) -> Array:
        """Time constant of the motors' torque, shape (n,), s; 0 without a lag."""
        bandwidth = 2.0 * np.pi * self.motor_bandwidth
        return np.divide(1.0, bandwidth, out=np.zeros_like(bandwidth), where=bandwidth > 0.0)

    def observers(self, dt: float) -> ObserverDesign:
        """Return the observers that estimate velocities.

        Args:
            dt: control period, s.
        """
        return design_observer(dt, self.position_error, self.acceleration_disturbance)


class UncertaintyMargins(NamedTuple):
    """What the bounds must hold for.

    Attributes:
        horizon: step of the bounds, s, at least `held`.
        position_error: E_q, largest error of the state's position, shape (n,), rad.
        velocity_error: E_v, largest error of its velocity, shape (n,), rad/s.
        held: longest time for which a command may act, s.
    """

    horizon: float
    position_error: Array
    velocity_error: Array
    held: float


def uncertainty_margins(
    declared: DeclaredUncertainty,
    dt: float,
    limits: JointLimits,
    acceleration_error: Array,
    errors: State,
    predicted: bool,
) -> UncertaintyMargins:
    """Return what the bounds must hold for.

    Args:
        declared: delay and its jitter, rows of missed deadlines, lag of the motors.
        dt: control period, s.
        limits: of n joints; of the accelerations commanded.
        acceleration_error: W, how far the acceleration may be from the one commanded, shape (n,),
            rad/s^2.
        errors: largest errors of position and velocity of a state for its own instant.
        predicted: whether the state is predicted to the instant when the command begins to act,
            lag of the motors included; otherwise the bounds take it as it is.
    """
    late, later = declared.delay * dt, declared.delay_jitter * dt
    lag = declared.motor_lag
    spread = limits.a_max - limits.a_min
    if predicted:
        wrong = wrong_periods(declared)
        velocity = errors.v + acceleration_error * (late + lag) + wrong * dt * spread
        position = errors.q + errors.v * (late + lag)
        position += acceleration_error * late * (0.5 * late + lag)
        if wrong:
            position += 0.5 * spread * (late**2 + later**2)
    else:
        fastest = np.maximum(-limits.a_min, limits.a_max) + acceleration_error
        velocity = errors.v + fastest * (late + lag) + spread * later
        position = errors.q + limits.v_max * (late + lag) + 0.5 * spread * later**2
    held = declared.periods_held * dt
    return UncertaintyMargins(held, position, velocity, held)


def wrong_periods(declared: DeclaredUncertainty) -> int:
    """Return in how many periods, at most, other commands act than the prediction expects.

    From the instant of a state to the one when the command that answers it begins to act. Where
    that is late, the prediction expects it to act already. Of any row of periods that is one
    longer than a command may be old, one period has a command that is expected in that row, so
    that only the order differs.
    """
    uncertain = declared.delay + declared.delay_jitter
    oldest = declared.delay_jitter + declared.missed_deadlines
    return uncertain - uncertain // (1 + oldest)


class Loop(NamedTuple):
    """A control loop, without what is uncertain in it.

    Attributes:
        limits: of n joints.
        torque_margins: off these limits, for the torque held in a control period.
        dt: control period, s.
        least_horizon: of the bounds, s.
        predicted: as in `uncertainty_margins`.
        observed: whether velocities are observed, not reported.
    """

    limits: JointLimits
    torque_margins: TorqueMargins
    dt: float
    least_horizon: float
    predicted: bool = False
    observed: bool = False

    def margins(self, declared: DeclaredUncertainty) -> UncertaintyMargins:
        """Return what the bounds must hold for; the horizon is that of the bounds."""
        source = declared.observers(self.dt) if self.observed else declared
        errors = State(source.position_error, source.velocity_error)
        w = self.torque_margins.acceleration + declared.acceleration_disturbance
        margins = uncertainty_margins(declared, self.dt, self.limits, w, errors, self.predicted)
        return margins._replace(horizon=max(self.least_horizon, margins.horizon))

    def bounds(self, declared: DeclaredUncertainty) -> BoundsSolver:
        """Return the bounds that hold for what is declared.

        Raises:
            JointLimitsError: there are none.
        """
        horizon, position_error, velocity_error, held = self.margins(declared)
        margins = self.torque_margins.held(declared.periods_held)
        return BoundsSolver(
            tightened(self.limits, margins),
            horizon,
            margins.acceleration + declared.acceleration_disturbance,
            held,
            position_error=position_error,
            velocity_error=velocity_error,
        )
