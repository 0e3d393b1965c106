# SPDX-License-Identifier: Apache-2.0
"""A recorded run: states, bounds and commands, matched by their stamps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class RecordedRun:
    """A recorded run; arrays of N control periods by n joints, NaN where a message was lost.

    Attributes:
        joints: names, n of them.
        t: shape (N,), s of robot time from the first recorded state.
        q, v: position and velocity, rad and rad/s.
        a_lower, a_upper: acceleration limits, rad/s^2.
        tau: commanded torque, N m; NaN under position control too.
        ft_wrench: of the force/torque sensor, force and torque, N and N m, shape (N, 6); NaN
            without a sensor.
        answered: whether there was a command, shape (N,).
    """

    joints: tuple[str, ...]
    t: Array
    q: Array
    v: Array
    a_lower: Array
    a_upper: Array
    tau: Array
    ft_wrench: Array
    answered: NDArray[np.bool_]

    @property
    def lost(self) -> int:
        """Number of periods without recorded limits or command."""
        return int((np.isnan(self.a_lower[:, 0]) | ~self.answered).sum())
