# SPDX-License-Identifier: Apache-2.0
"""Gains of the tasks."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Gains:
    """What may change while the controller runs.

    Attributes:
        pose_kp, pose_kd: of the pose task, 1/s^2 and 1/s.
        pose_weight: of the pose task; 0 leaves the task out.
        posture_kp, posture_kd: of the posture task, 1/s^2 and 1/s.
        posture_weight: of the posture task, > 0.
        posture_in_null_space: whether the posture leaves the pose alone.
        hold_kd: damping in HOLD, 1/s.
        disturbance_time: time constant with which what disturbs the accelerations is learned
            and kept out of the bounds, s; None not to.
    """

    pose_kp: float
    pose_kd: float
    pose_weight: float
    posture_kp: float
    posture_kd: float
    posture_weight: float
    posture_in_null_space: bool
    hold_kd: float
    disturbance_time: float | None = None


def critical_damping(kp: float) -> float:
    """Return ``2 sqrt(kp)``, the gain that brings an error to zero fastest without overshoot."""
    return 2.0 * math.sqrt(kp)
