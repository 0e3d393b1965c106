# SPDX-License-Identifier: Apache-2.0
"""Slows the arm: it serves its goals by a share, and the rest of its accelerations brake it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from torque_safety_controller.qp import AccelerationRange, TaskTerm

Array = NDArray[np.float64]

STOP_TIME = 0.02
"""Time constant by which a joint within its margins stops that moves on towards a limit, s."""

LATE_PERIODS = 3
"""Periods that a command of a joint near its limit may come late."""

RISE_TIME = 0.5
"""In which goals get all of their effect back, s of robot time."""

FALL_TIME = 0.05
"""In which they lose it where the robot may still obey, s."""

REST_TIME = 1.0
"""After which an arm that does not come to rest goes on, s: one that is shaken never does."""

_UNBOUNDED = 1e6
"""Stands for the width of bounds that are infinite, rad/s^2."""


class SlowDown:
    """Blends tasks and bounds towards rest while the arm may serve its goals by a share only.

    Args:
        position_limits: lower and upper, without margins, shape (n,) each, rad; None if they are
            not known: then the arm returns from their margins as fast as its bounds ask.
        period: of control, s.
    """

    def __init__(self, position_limits: tuple[Array, Array] | None, period: float) -> None:
        self._position_limits, self._period = position_limits, period

    def return_bounds(
        self, bounds: AccelerationRange, q: Array, v: Array, share: float
    ) -> AccelerationRange:
        """Return bounds by which a joint within the margins of a limit returns by a share only.

        The bounds of such a joint demand to be back after two periods: a jolt for an arm that was
        stopped there. Here they demand the share of it, and of a joint that moves on towards
        its limit to brake by

            max(|v| / `STOP_TIME`, v^2 / (r - 2 `LATE_PERIODS` h |v|)),

        r the room to the limit and h the period, so that it stops in less than half of the room
        even where commands are late; never more than the bounds themselves demand.

        Args:
            bounds: of the accelerations, shape (n,) each, rad/s^2.
            q: position, shape (n,), rad.
            v: velocity, shape (n,), rad/s.
            share: from 0 to 1.
        """
        if self._position_limits is None or share >= 1.0:
            return bounds
        lower, upper = bounds
        low, high = self._position_limits
        speed = np.abs(v)
        room = np.where(v > 0.0, high - q, q - low) - 2.0 * LATE_PERIODS * self._period * speed
        with np.errstate(divide="ignore", invalid="ignore"):
            brake = np.where(room > 0.0, np.maximum(speed / STOP_TIME, v * v / room), np.inf)
        inward = np.maximum(share * lower, np.where(v < 0.0, brake, 0.0))
        outward = np.minimum(share * upper, np.where(v > 0.0, -brake, 0.0))
        return AccelerationRange(
            np.where(lower > 0.0, np.minimum(inward, lower), lower),
            np.where(upper < 0.0, np.maximum(outward, upper), upper),
        )

    @staticmethod
    def tasks(terms: Sequence[TaskTerm], rest: Array, share: float) -> list[TaskTerm]:
        """Return the terms that ask for their share, and for the rest of braking.

        Args:
            terms: of the tasks.
            rest: accelerations that bring the arm to rest, shape (n,), rad/s^2.
            share: from 0 to 1.
        """
        return [term.mixed(rest, share) for term in terms]

    @staticmethod
    def bounds(bounds: AccelerationRange, rest: Array, share: float) -> AccelerationRange:
        """Return the share of the bounds that is nearest to coming to rest.

        A goal that is far away asks for far more than the bounds allow: a small share of it, too.

        Args:
            bounds: of the accelerations, shape (n,) each, rad/s^2.
            rest: accelerations that bring the arm to rest, shape (n,), rad/s^2.
            share: from 0 to 1.
        """
        lower, upper = bounds
        near = np.minimum(np.maximum(rest, lower), upper)
        reach = share * np.minimum(upper - lower, _UNBOUNDED)
        return AccelerationRange(np.maximum(lower, near - reach), np.minimum(upper, near + reach))


class Ramp:
    """Scales goals to zero after a fault, then ramps back once the arm rests.

    The share is the square of a ramp in time: goals far away ask for so much that already a small
    share is a large torque. It falls by all the time that has gone by, and rises by one period
    for each state, however many were missed.

    Args:
        period: of control, s.
    """

    def __init__(self, period: float) -> None:
        self._period = period
        self._ramp, self._falls, self._waited = 1.0, False, 0.0

    @property
    def share(self) -> float:
        """From 0, the arm is brought to rest, to 1."""
        return self._ramp**2

    def fall(self, at_once: bool = False) -> None:
        """Let the share go to zero: at once, or within `FALL_TIME`."""
        if self._ramp > 0.0:
            self._falls, self._waited = True, 0.0
        if at_once:
            self._ramp, self._falls = 0.0, False

    def advance(self, elapsed: float, at_rest: bool, waits: bool = False) -> None:
        """Let the share fall, wait or rise.

        Args:
            elapsed: time since the last state, s.
            at_rest: whether the arm rests; it is waited for where the share is zero.
            waits: whether the share is not to rise.
        """
        if self._falls:
            self._ramp = max(0.0, self._ramp - elapsed / FALL_TIME)
            self._falls = self._ramp > 0.0
        elif self._ramp == 0.0 and not at_rest and self._waited < REST_TIME:
            self._waited += elapsed
        elif not waits:
            self._ramp = min(1.0, self._ramp + min(elapsed, self._period) / RISE_TIME)
