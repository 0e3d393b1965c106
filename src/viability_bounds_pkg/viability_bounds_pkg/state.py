# SPDX-License-Identifier: Apache-2.0
"""The state of an arm: joint positions and velocities; angles of joints that turn without end."""

from __future__ import annotations

import math
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


def whole_turns(
    q: NDArray[np.float64], near: NDArray[np.float64], continuous: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Return what to add to angles so that they are within half a turn of others.

    Args:
        q: angles, shape (n,), rad.
        near: the others, shape (n,), rad.
        continuous: whether a joint has no position limits; 0 is added to the others, shape (n,).
    """
    return np.where(continuous, math.tau * np.round((near - q) / math.tau), 0.0)
