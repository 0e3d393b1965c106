# SPDX-License-Identifier: Apache-2.0
"""The state of an arm: joint positions and velocities."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class State(NamedTuple):
    """Positions and velocities of n joints at one time.

    Attributes:
        q: positions, shape (n,), rad.
        v: velocities, shape (n,), rad/s.
    """

    q: NDArray[np.float64]
    v: NDArray[np.float64]

    def after(self, a: NDArray[np.float64], dt: float) -> State:
        """Return the state after time `dt` at constant acceleration `a`, shape (n,), rad/s^2."""
        dv = dt * a
        return State(self.q + dt * (self.v + 0.5 * dv), self.v + dv)
