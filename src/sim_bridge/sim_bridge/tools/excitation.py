# SPDX-License-Identifier: Apache-2.0
"""A motion from which the friction of every joint can be identified, independent of masses.

All joints move at once, in parts of whole periods of cosines,

    q_i(t) = q_start_i + (A_i / 2) (1 - cos(2 pi k_i t / T)),

which begin and end at rest. Each part is symmetric in time: every configuration is passed with a
velocity and its opposite, at the same acceleration. The torques of rigid-body dynamics are then
equal, those of friction opposite.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from viability_bounds_pkg.exceptions import ArmSafetyError
from viability_bounds_pkg.robot.configuration import LimitedRobotConfiguration

Array = NDArray[np.float64]

PARTS = ((10.0, 0.04, np.inf), (16.0, 0.15, np.inf), (10.0, np.inf, 1.0))
"""Duration T, s; greatest speed, rad/s; and greatest frequency, 1/s."""

ROOM = 0.9
"""Share of the distance to a position limit that is used."""


class ExcitationError(ArmSafetyError, ValueError):
    """The motion does not fit into the limits of the joints."""


def excitation(
    arm: LimitedRobotConfiguration,
    q_start: Array,
    dt: float,
    amplitude: float = 0.6,
    speed: float = 0.5,
) -> tuple[Array, Array]:
    """Return positions and velocities, shape (N, n), rad and rad/s, at the period `dt`, s.

    Each joint moves to the side on which it has more room.

    Args:
        arm: its n joints and their limits; position limits may be infinite.
        q_start: positions at start and end, shape (n,), rad.
        dt: period, s.
        amplitude: greatest A, rad.
        speed: greatest share of the velocity limits.

    Raises:
        ExcitationError: a joint starts outside its limits or too near to both.
    """
    q_min, q_max, v_max = arm.position_min, arm.position_max, arm.velocity_max
    room = np.maximum(q_max - q_start, q_start - q_min)
    for joint, q, low, high, most in zip(arm.joints, q_start, q_min, q_max, room, strict=True):
        if not low <= q <= high:
            raise ExcitationError(f"joint {joint} starts at {q:g}, outside its limits")
        if ROOM * most < 0.05:
            raise ExcitationError(f"joint {joint} has {most:.3g} rad of room only")
    side = np.where(q_max - q_start >= q_start - q_min, 1.0, -1.0)
    largest = np.minimum(amplitude, ROOM * room)
    q, v = [], []
    for duration, speed_max, frequency in PARTS:
        peak = np.minimum(speed_max, speed * v_max)
        # A cosine of k periods is as fast as pi k A / T.
        periods = np.clip(np.floor(peak * duration / (np.pi * largest)), 1, duration * frequency)
        reach = side * np.minimum(largest, peak * duration / (np.pi * periods))
        omega = 2.0 * np.pi * periods / duration
        phase = np.outer(dt * np.arange(round(duration / dt)), omega)
        q.append(q_start + 0.5 * reach * (1.0 - np.cos(phase)))
        v.append(0.5 * reach * omega * np.sin(phase))
    return np.vstack(q), np.vstack(v)
