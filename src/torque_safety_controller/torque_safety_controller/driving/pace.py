# SPDX-License-Identifier: Apache-2.0
"""Time along a trajectory, which waits for the arm.

Let e be where the arm lags behind the trajectory in the direction of motion, as a share of the
largest lead, L: `jog.JOINT_LEAD` or `jog.HAND_LEAD`. The time s along the trajectory passes with

    ds / dt = 1 for e <= 0.2,   (1 - e) / 0.8 down to 0 for e >= 1,

so that brakes, pushes, limits and slowed goals stretch it. An arm that is let go then has no more
than L to catch up with. Across the direction of motion it is free, as where it slides on a table.
"""

from __future__ import annotations

from torque_safety_controller.step import LONGEST_GAP

GAP = 0.1
"""Of a longer time without an answer no more counts, s: the arm has stopped meanwhile."""

PATH_TOLERANCE = 5.0
"""Distance at which a trajectory is given up, in times of L."""

_STANDS = 0.1


class Pace:
    """Stretches the time along a trajectory.

    Args:
        begin: time 0 of the trajectory, ns; 0 for the first step.
        dt: control period, s.

    Attributes:
        begin: as given, or the stamp of the first step, ns.
        rate: ds / dt.
        near: whether the arm has been within L of the trajectory; before that its beginning waits.
        lost: whether the arm is farther away than `PATH_TOLERANCE`.
    """

    def __init__(self, begin: int, dt: float) -> None:
        self.begin = begin
        self.rate, self.near, self.lost = 1.0, False, False
        self._gap = max(GAP, LONGEST_GAP * dt)
        self._stamp = -1
        self._waited = 0.0

    def time(self, stamp: int) -> float:
        """Return the time along the trajectory at `stamp`, ns, in s."""
        self.begin = self.begin or stamp
        if self._stamp >= 0:
            elapsed = 1e-9 * (stamp - self._stamp)
            self._waited += elapsed - self.rate * min(max(elapsed, 0.0), self._gap)
        self._stamp = stamp
        return 1e-9 * (stamp - self.begin) - self._waited

    def follow(self, behind: float, off: float) -> None:
        """Find the pace until the next step.

        Args:
            behind: e.
            off: distance of the arm from the trajectory, in times of L.
        """
        self.near = self.near or off <= 1.0
        self.rate = min(max(1.25 - 1.25 * behind, 0.0), 1.0) if self.near else 0.0
        self.lost = self.near and off > PATH_TOLERANCE

    @property
    def waits(self) -> bool:
        """Whether the trajectory all but stands still."""
        return self.rate < _STANDS
