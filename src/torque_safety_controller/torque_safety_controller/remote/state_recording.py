# SPDX-License-Identifier: Apache-2.0
"""States of an arm over time, kept by a client while its program waits."""

from __future__ import annotations

import math
from collections.abc import Sequence
from os import PathLike

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import JointState

from viability_bounds_pkg.ros.messages import Arrival, JointStateReader

Array = NDArray[np.float64]


class StateRecording:
    """States in the order of their stamps; N of n joints. Some of a fast robot may be lost.

    Args:
        joints: names of the n joints.
    """

    def __init__(self, joints: Sequence[str]) -> None:
        self._reader = JointStateReader(joints)
        self._unknown = np.full(len(joints), math.nan)
        self._stamps: list[int] = []
        self._states: list[tuple[Array, Array, Array]] = []

    def add(self, message: JointState, now: float) -> None:
        """Keep the state in a message that came at `now`, s, if it can be used."""
        if self._reader.read(message, now) is Arrival.NEW:
            tau = self._reader.effort()
            self._stamps.append(self._reader.stamp)
            self._states.append(
                (self._reader.q, self._reader.v, self._unknown if tau is None else tau)
            )

    @property
    def t(self) -> Array:
        """Time of the robot since the first state, shape (N,), s."""
        stamps = np.array(self._stamps, dtype=np.int64)
        return 1e-9 * (stamps - stamps[:1]).astype(float)

    @property
    def q(self) -> Array:
        """Positions, shape (N, n), rad."""
        return self._column(0)

    @property
    def v(self) -> Array:
        """Velocities, shape (N, n), rad/s."""
        return self._column(1)

    @property
    def tau(self) -> Array:
        """Torques of the motors, shape (N, n), N m; NaN where the robot does not tell."""
        return self._column(2)

    def save(self, path: str | PathLike[str]) -> None:
        """Write t, q, v and tau to an ``npz`` file."""
        np.savez_compressed(path, t=self.t, q=self.q, v=self.v, tau=self.tau)

    def _column(self, which: int) -> Array:
        rows = [state[which] for state in self._states]
        return np.array(rows).reshape(len(rows), len(self._unknown))
