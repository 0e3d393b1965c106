# SPDX-License-Identifier: Apache-2.0
"""What parameter files say of a robot's delay, bandwidth and resolution, for other nodes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torque_safety_controller.loop_margins.arm_inertia import ArmInertia
from torque_safety_controller.loop_margins.gain_check import GainCheck, GainSettings, RobotTiming
from torque_safety_controller.parameters.controller_parameters import ControllerConfiguration
from viability_bounds_pkg.parameter import (
    NEGATIVE,
    NOT_NEGATIVE,
    POSITIVE,
    Range,
    joint_numbers,
    number,
    read,
    whole_number,
)
from viability_bounds_pkg.robot_configuration import ControlRate, LimitedRobotConfiguration

Array = NDArray[np.float64]

DECLARING = "bounds_node", "estimator_node"
"""Nodes whose sections are read, besides that for all nodes; the last one given counts."""


@dataclass(frozen=True, eq=False, kw_only=True)
class LoopConfiguration(ControlRate, LimitedRobotConfiguration):
    """What the loops' margins depend on besides the gains; arrays of shape (n,)."""

    acceleration_min: Array = joint_numbers("see bounds_node", NEGATIVE)
    acceleration_max: Array = joint_numbers("see bounds_node", POSITIVE)
    acceleration_disturbance: Array = joint_numbers("see bounds_node", NOT_NEGATIVE, if_empty=0.0)
    bounds_dt_factor: float = number("see bounds_node", Range(1.0, 1e3), default=2.0)
    position_error: Array = joint_numbers("see bounds_node", NOT_NEGATIVE, if_empty=0.0)
    velocity_error: Array = joint_numbers("see bounds_node", NOT_NEGATIVE, if_empty=0.0)
    delay: int = whole_number("see bounds_node", Range(0, 100), default=0)
    delay_jitter: int = whole_number("see bounds_node", Range(0, 100), default=0)
    missed_deadlines: int = whole_number("see bounds_node", Range(0, 100), default=0)
    motor_bandwidth: Array = joint_numbers("see bounds_node", NOT_NEGATIVE, if_empty=0.0)

    @property
    def imperfect(self) -> bool:
        """Whether any delay, lag or error is declared."""
        errors = (self.position_error, self.velocity_error, self.motor_bandwidth)
        return self.delay + self.delay_jitter > 0 or any(each.any() for each in errors)

    @property
    def horizon(self) -> float:
        """Horizon of the bounds in control periods, which missed deadlines lengthen."""
        return max(self.bounds_dt_factor, 1.0 + self.missed_deadlines + self.delay_jitter)

    def timing(self, estimated: bool) -> RobotTiming:
        """Return what the margins are computed with.

        Args:
            estimated: whether the controller uses estimated states.
        """
        bandwidth = 2.0 * np.pi * self.motor_bandwidth
        return RobotTiming(
            dt=self.dt,
            delay=self.delay,
            delay_jitter=self.delay_jitter,
            motor_bandwidth=np.where(bandwidth > 0.0, bandwidth, np.inf),
            position_error=self.position_error,
            velocity_error=self.velocity_error,
            acceleration_disturbance=self.acceleration_disturbance,
            braking=np.minimum(-self.acceleration_min, self.acceleration_max),
            bounds_dt_factor=self.horizon,
            estimated=estimated,
        )


def read_loop(sections: Callable[[str], Mapping[str, Any]]) -> LoopConfiguration:
    """Return what is declared.

    Args:
        sections: returns the values given for a node, by parameter.

    Raises:
        SettingError: a value is missing, of another type, or not allowed.
    """
    given: dict[str, Any] = {}
    for node in DECLARING:
        given |= sections(node)
    return read(LoopConfiguration, given)


def gain_check(
    config: ControllerConfiguration, loop: LoopConfiguration, inertia: ArmInertia
) -> GainCheck:
    """Return the check of a controller's gains.

    Args:
        config: of the controller.
        loop: of the robot.
        inertia: of the arm.
    """
    gains, integral = config.gains, config.additional.integral
    tasks = {
        "pose": (gains.pose_kp, gains.pose_kd),
        "posture": (gains.posture_kp, gains.posture_kd),
        "hold": (0.0, gains.hold_kd),
    }
    if gains.pose_weight <= 0.0:
        del tasks["pose"]
    settings = GainSettings(
        {name: pair for name, pair in tasks.items() if pair[1] > 0.0},
        0.0 if config.additional.mode == "none" else integral.gain,
        (integral.slow_leak_rate, integral.fast_leak_rate, integral.mu),
        gains.disturbance_time,
    )
    estimated = getattr(config, "use_estimated_states", False)
    return GainCheck(settings, loop.timing(estimated), inertia, config.torque_max)
