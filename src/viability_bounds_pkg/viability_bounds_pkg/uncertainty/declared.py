# SPDX-License-Identifier: Apache-2.0
"""The parameters by which users declare what is uncertain about their robot.

They are what the bounds and the state estimation hold against; `docs/uncertainty.md` derives what
follows from them. All zero: states are exact, commands act at once.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from viability_bounds_pkg.parameter import joint_amounts, periods, switch
from viability_bounds_pkg.state_estimation.observer import ObserverDesign, design_observer

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False, kw_only=True)
class VelocityEstimation:
    """Where the velocities in estimated joint states come from."""

    velocity_estimation: bool = switch(
        "whether velocities are estimated from positions and torques; false takes those that the "
        "robot reports",
        default=True,
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class DeclaredUncertainty:
    """Largest errors of states, times and accelerations; arrays of shape (n,)."""

    position_error: Array = joint_amounts(
        "largest error of a reported position, rad: resolution and noise of the encoder; 0 if "
        "empty"
    )
    velocity_error: Array = joint_amounts(
        "largest error of a reported velocity, rad/s; 0 if empty",
        note="not used with use_estimated_states, where the observer's own error counts",
    )
    acceleration_disturbance: Array = joint_amounts(
        "how much more than commanded the joints may accelerate by what the model does not know, "
        "friction, payloads, pushes, rad/s^2; the bounds are tightened by it; 0 if empty"
    )
    lasting_disturbance: Array = joint_amounts(
        "up to which the estimator learns what the model does not know and lasts, friction, "
        "payloads, wrong masses, rad/s^2, so that velocities of joints at rest have no bias; its "
        "errors are guaranteed where acceleration_disturbance covers the rest; 0 if empty"
    )
    delay: int = periods(
        "control periods from the instant of a reported state to the one when the command that "
        "answers it begins to act"
    )
    delay_jitter: int = periods("control periods by which the delay may be longer at times")
    missed_deadlines: int = periods(
        "longest row of control periods in which no new command arrives and the robot keeps the "
        "last one"
    )
    motor_bandwidth: Array = joint_amounts(
        "bandwidth of the motors' torque as a first-order lag, Hz; 0 or empty: no lag"
    )

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
