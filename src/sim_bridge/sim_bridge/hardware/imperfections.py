# SPDX-License-Identifier: Apache-2.0
"""The parameters of imperfect hardware."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from viability_bounds_pkg.exceptions import SettingError
from viability_bounds_pkg.parameter import (
    Range,
    joint_amounts,
    joint_numbers,
    number,
    periods,
    text,
    whole_number,
)

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False, kw_only=True)
class Imperfections:
    """What distinguishes real hardware from an ideal one; arrays of shape (n,)."""

    encoder_resolution: Array = joint_amounts("step of the encoders, rad; 0 or empty: exact")
    position_noise: Array = joint_amounts(
        "standard deviation of the encoders' noise, before it is rounded to their steps and "
        "clipped at 3 of it, rad; none if empty"
    )
    velocity_source: str = text(
        "exact: the true velocity; encoder: difference of two encoder positions over a period",
        default="exact",
        choices=("exact", "encoder"),
    )
    velocity_filter_hz: float = number(
        "first-order low-pass of the drives for the velocity, Hz; 0: none",
        Range(0.0, 5000.0),
        default=0.0,
        note="below half of rate_hz",
    )
    velocity_noise: Array = joint_amounts(
        "standard deviation of the noise of reported velocities, clipped at 3 of it, rad/s; none "
        "if empty"
    )
    state_delay: int = periods("control periods by which states are reported late")
    command_delay: int = periods(
        "control periods by which commands act late; in real time they may come so much later"
    )
    motor_bandwidth: Array = joint_amounts(
        "bandwidth of the motors' torque, a first-order lag, Hz; 0 or empty: infinite"
    )
    torque_constant_error: Array = joint_numbers(
        "share by which the true torque is larger than the reported one; 0 if empty",
        Range(-0.5, 0.5),
        if_empty=0.0,
    )
    torque_ripple: Array = joint_numbers(
        "amplitude of torque that changes with the motor's angle, share of torque_max; 0 if empty",
        Range(0.0, 0.5),
        if_empty=0.0,
    )
    current_noise: Array = joint_numbers(
        "standard deviation of the noise of the torque and, apart from that, of the reported "
        "effort, clipped at 3 of it, share of torque_max; 0 if empty",
        Range(0.0, 0.2),
        if_empty=0.0,
    )
    missed_probability: float = number(
        "probability that a command misses its period, in which the last one is held then",
        Range(0.0, 1.0, without=1.0),
        default=0.0,
    )
    missed_in_row: int = whole_number("longest row of such periods", Range(1, 1000), default=4)
    outage_probability: float = number(
        "probability of each command that an outage begins with it, in which all are lost",
        Range(0.0, 1.0, without=1.0),
        default=0.0,
    )
    outage_longest: int = whole_number(
        "longest outage, control periods; each length up to it is as likely",
        Range(1, 10_000),
        default=100,
    )
    imperfection_seed: int = whole_number(
        "seed of all these random numbers", Range(0, 2**31 - 1), default=0
    )

    def check_rate(self, rate_hz: float) -> None:
        """Check that the filter passes less than a signal of that rate can have.

        Raises:
            SettingError: it does not.
        """
        if not self.velocity_filter_hz < 0.5 * rate_hz:
            allowed = f"a number below half of rate_hz, {0.5 * rate_hz:g}; 0: no filter"
            raise SettingError("velocity_filter_hz", self.velocity_filter_hz, allowed)

    @property
    def motor_lag(self) -> Array:
        """Time constant of the motors' torque, shape (n,), s; 0 without a lag."""
        omega = 2.0 * np.pi * self.motor_bandwidth
        return np.divide(1.0, omega, out=np.zeros_like(omega), where=omega > 0.0)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters that make a difference."""
        return tuple(each.name for each in fields(self) if self._is_on(each.name))

    def any_of(self, *names: str) -> bool:
        """Return whether one of these parameters makes a difference."""
        return any(map(self._is_on, names))

    def _is_on(self, name: str) -> bool:
        if name in ("missed_in_row", "outage_longest", "imperfection_seed"):
            return False
        value = getattr(self, name)
        return value != "exact" if isinstance(value, str) else bool(np.any(value))

    @property
    def of_sensing(self) -> bool:
        """Whether readings differ from the true state."""
        return self.any_of(
            "encoder_resolution",
            "position_noise",
            "velocity_source",
            "velocity_filter_hz",
            "velocity_noise",
            "state_delay",
            "current_noise",
        )

    @property
    def of_motors(self) -> bool:
        """Whether torques differ from those asked for."""
        return self.any_of(
            "motor_bandwidth", "torque_constant_error", "torque_ripple", "current_noise"
        )
