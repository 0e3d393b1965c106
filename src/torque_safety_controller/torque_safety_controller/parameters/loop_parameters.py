# SPDX-License-Identifier: Apache-2.0
"""The check of gains that the parameters of the controller and of the bounds node give."""

from __future__ import annotations

import numpy as np

from torque_safety_controller.loop_margins.arm_inertia import ArmInertia
from torque_safety_controller.loop_margins.gain_check import GainCheck, GainSettings, RobotTiming
from torque_safety_controller.parameters.controller_parameters import ControllerConfiguration
from viability_bounds_pkg.node.bounds_parameters import BoundsConfiguration


def gain_check(
    config: ControllerConfiguration, robot: BoundsConfiguration, inertia: ArmInertia
) -> GainCheck:
    """Return the check of a controller's gains.

    Args:
        config: of the controller.
        robot: what is declared, and the horizon of the bounds.
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
    estimated = config.use_estimated_states
    timing = RobotTiming(
        dt=robot.dt,
        declared=robot.declared,
        braking=np.minimum(-robot.limits.a_min, robot.limits.a_max),
        horizon=robot.horizon / robot.dt,
        predicted=estimated,
        observed=estimated and robot.velocity_estimation,
    )
    return GainCheck(settings, timing, inertia, config.torque_max)
