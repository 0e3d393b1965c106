# SPDX-License-Identifier: Apache-2.0
"""One joint first, where an arm stands short of its goal because it cannot hold the way."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

STILL = 0.05
"""Speed below which the arm stands, rad/s."""

SHORT = 0.05
"""Distance from its goal at which some joint must be for a detour, rad."""

LOADED = 0.9
"""Share of a torque limit that holding the arm must take for a detour."""

PATIENCE = 0.2
"""How long the arm stands before a detour begins, s."""

LONGEST = 3.0
"""How long a detour lasts at most, s."""

NEAR = 0.02
"""Distance from its goal at which the joint that goes first has arrived, rad."""

OTHERS = 0.03
"""Share of the other joints' errors that counts meanwhile."""


class Detour:
    """Tells whose errors count, all or those of the joint that has most to hold.

    The safety filter lets the arm glide along postures that it can just hold, as far as that
    brings it nearer to its goal. There it may stand for ever: the elbow would have to bend, though
    its goal is straight, for the shoulder to go on. So the shoulder goes first.

    Args:
        dt: control period, s.

    Attributes:
        joint: that goes first; None outside of detours.
    """

    def __init__(self, dt: float) -> None:
        self._dt = dt
        self._goal: Array | None = None
        self._possible = False
        self.reset()

    def reset(self) -> None:
        """Forget the past."""
        self.joint: int | None = None
        self._time = 0.0

    def shares(
        self, q_des: Array, q: Array, v: Array, load: Array, can_hold: Callable[[Array], bool]
    ) -> Array | None:
        """Return the share of each joint's error that counts, shape (n,), or None for all of it.

        Args:
            q_des: goal, shape (n,), rad; another array than before is another goal.
            q: positions, shape (n,), rad.
            v: velocities, shape (n,), rad/s.
            load: what holds the arm, as a share of the torque limits, shape (n,).
            can_hold: whether a posture can be held; to one that cannot there are no detours.
        """
        if q_des is not self._goal:
            self._goal, self._possible = q_des, can_hold(q_des)
            self.reset()
        if not self._possible:
            return None
        off = np.abs(q_des - q)
        self._time += self._dt
        if self.joint is None:
            stuck = (
                float(np.abs(v).max()) < STILL
                and float(off.max()) > SHORT
                and float(load.max()) > LOADED
            )
            if not stuck:
                self._time = 0.0
            if self._time <= PATIENCE + 0.5 * self._dt:
                return None
            most = int(load.argmax())
            self.joint = most if off[most] > NEAR else int(off.argmax())
            self._time = 0.0
        elif off[self.joint] < NEAR or self._time > LONGEST:
            self.reset()
            return None
        shares = np.full(q.size, OTHERS)
        shares[self.joint] = 1.0
        return shares
