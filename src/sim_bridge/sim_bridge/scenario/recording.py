# SPDX-License-Identifier: Apache-2.0
"""A recorded run: states, bounds and commands, matched by their stamps."""

from __future__ import annotations

from collections.abc import Sequence
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


Row = Sequence[float]


class Recorder:
    """Collects messages in any order and sorts them by stamp at the end."""

    def __init__(self, joints: Sequence[str]) -> None:
        self._joints = tuple(joints)
        self._states: dict[int, tuple[Row, Row]] = {}
        self._limits: dict[int, tuple[Row, Row]] = {}
        self._torques: dict[int, Row] = {}
        self._wrenches: dict[int, Row] = {}

    def add_state(self, stamp: int, q: Row, v: Row) -> None:
        """Record a state, rad and rad/s, with its stamp in ns."""
        self._states[stamp] = (q, v)

    def add_limits(self, stamp: int, lower: Row, upper: Row) -> None:
        """Record the acceleration limits, rad/s^2, for the state with `stamp`."""
        self._limits[stamp] = (lower, upper)

    def add_torque(self, stamp: int, tau: Row) -> None:
        """Record the torques, N m, for the state with `stamp`; empty under position control."""
        self._torques.setdefault(stamp, tau)

    def add_wrench(self, stamp: int, wrench: Row) -> None:
        """Record the force/torque sensor's wrench in the state with `stamp`, N and N m."""
        self._wrenches[stamp] = wrench

    def run(self, first: int) -> RecordedRun:
        """Return the run from the state with stamp `first` on."""
        stamps = sorted(stamp for stamp in self._states if stamp >= first)
        nan = [np.nan] * len(self._joints)
        states = np.array([self._states[s] for s in stamps])
        limits = np.array([self._limits.get(s, (nan, nan)) for s in stamps])
        return RecordedRun(
            joints=self._joints,
            t=(np.array(stamps) - first) * 1e-9,
            q=states[:, 0],
            v=states[:, 1],
            a_lower=limits[:, 0],
            a_upper=limits[:, 1],
            tau=np.array([self._torques.get(s) or nan for s in stamps]),
            ft_wrench=np.array([self._wrenches.get(s, [np.nan] * 6) for s in stamps]),
            answered=np.array([s in self._torques for s in stamps]),
        )
