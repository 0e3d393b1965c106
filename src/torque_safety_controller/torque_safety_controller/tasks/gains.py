# SPDX-License-Identifier: Apache-2.0
"""Gains of the tasks."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from viability_bounds_pkg.parameter import POSITIVE, Range, above, number, numbers, text

Array = NDArray[np.float64]

POSE_ERRORS = ("separate", "logarithm")
"""Errors of a pose: position and orientation apart, or the logarithm of SE(3)."""

CRITICAL = -1.0
"""Of ``pose_kd`` and ``posture_kd``: critical damping."""


def _damping(task: str) -> Any:
    return number(
        f"damping of the {task} task, 1/s; -1: critical, 2 sqrt(kp)",
        above(0.0, 1e4, special=CRITICAL),
        default=CRITICAL,
        live=True,
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class Gains:
    """What may change while the controller runs.

    `CRITICAL` damping becomes a number when the gains are made.
    """

    pose_kp: float = number("stiffness of the pose task, 1/s^2", Range(0.0, 1e5), live=True)
    pose_kd: float = _damping("pose")
    pose_weight: float = number(
        "weight of the pose task; 0: no pose task", Range(0.0, 1e5), default=1.0, live=True
    )
    pose_error: str = text(
        "separate: position and orientation apart, so that the hand moves straight; logarithm: "
        "of SE(3), along a screw",
        default="separate",
        live=True,
        choices=POSE_ERRORS,
    )
    pose_speed_max: Array = numbers(
        "largest speeds at which the pose task approaches its goal, m/s and rad/s; no limit if "
        "empty",
        POSITIVE,
        length=2,
        default=(),
        live=True,
    )
    posture_kp: float = number("stiffness of the posture task, 1/s^2", Range(0.0, 1e5), live=True)
    posture_kd: float = _damping("posture")
    posture_weight: float = number(
        "weight of the posture task", above(0.0, 1e5), default=1e-3, live=True
    )
    hold_kd: float = number("damping in HOLD, 1/s", Range(0.0, 1e4), default=20.0, live=True)
    disturbance_time: float = number(
        "time constant of the disturbance observer, which tightens the bounds, s; 0: off",
        Range(0.0, 0.1),
        default=0.0,
    )

    def __post_init__(self) -> None:
        """Resolve the special values."""
        if self.pose_kd == CRITICAL:
            object.__setattr__(self, "pose_kd", critical_damping(self.pose_kp))
        if self.posture_kd == CRITICAL:
            object.__setattr__(self, "posture_kd", critical_damping(self.posture_kp))

    @property
    def pose_error_max(self) -> tuple[float, float]:
        """Errors of translation, m, and rotation, rad, beyond which the pose task is no stiffer.

        Damping then balances stiffness at `pose_speed_max`: kp error = kd speed.
        """
        if not len(self.pose_speed_max) or self.pose_kp == 0.0:
            return math.inf, math.inf
        linear, angular = (self.pose_speed_max * (self.pose_kd / self.pose_kp)).tolist()
        return linear, angular


def critical_damping(kp: float) -> float:
    """Return ``2 sqrt(kp)``, the gain that brings an error to zero fastest without overshoot."""
    return 2.0 * math.sqrt(kp)
