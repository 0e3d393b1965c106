# SPDX-License-Identifier: Apache-2.0
"""Refuses joint states that are physically impossible after those before them.

A state is refused where

- a position is outside its limits by more than their range, or a speed `IMPOSSIBLE` times as
  large as its limit;
- a position has moved by more than `FAST` times the speed limit allows: a jump;
- positions and velocities have contradicted each other over `WINDOW`: with h between two states,

      d(t + h) = exp(-h / WINDOW) d(t) + q - q0 - h (v0 + v) / 2

  is more than what errors, and one impact within h, explain. States that freeze in motion do.

Afterwards states are accepted again at once if they follow the last accepted one. Else they must
have been plausible among themselves for `WINDOW`, and no joint may be farther away than it moves
within `STOPPING`. After a gap of `GAP` in the stamps anything in range is accepted: robots that
restart make one.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from viability_bounds_pkg.state import State

Array = NDArray[np.float64]

WINDOW = 0.2
"""Over which positions are compared with velocities, and how long they must agree again, s."""

GAP = 0.1
"""Time between states after which the later one is a new beginning, s; three periods at least."""

STOPPING = 0.8
"""How long an arm whose states are refused may move at its speed limits until it stands, s."""

RESTART_GAP = 1.0
"""By how much the stamps of a robot leap that has started again, s."""

POSITION_ERROR = 2e-3
"""Error of positions that need not be declared, rad: 1 ms of the stamps at 2 rad/s."""

VELOCITY_ERROR = 0.05
"""Error of velocities that need not be declared, as a share of the speed limits: filters."""

FAST = 2.0
"""How many times faster than its limit a joint may move: it may be pushed."""

IMPOSSIBLE = 10.0
"""How many times faster than its limit no joint ever moves."""

NO_SPEED_LIMIT = 10.0
"""Speed limit of a joint that has none, rad/s."""

FARTHEST = 1e6
"""Position that no joint has, also where it has no limits, rad."""

OUTSIDE = "beyond a limit by more than the range of the joint"
TOO_FAST = f"more than {IMPOSSIBLE:g} times faster than the speed limit"
JUMP = "a position jumped"
CONTRADICTION = "positions contradict velocities"
NOT_LATER = "not later than the last one"


class _Past(NamedTuple):
    """A state, its time in s, and by how far positions have outrun velocities, shape (n,), rad."""

    state: State
    time: float
    drift: Array


class PlausibilityCheck:
    """Checks the states of an arm, one after the other.

    Args:
        position_min: lower position limits, shape (n,), rad; -inf for none.
        position_max: upper ones, shape (n,), rad; inf for none.
        velocity_max: speed limits, shape (n,), rad/s; inf for none.
        dt: control period, s.
        position_error: declared error of positions, shape (n,), rad.
        velocity_error: declared error of velocities, shape (n,), rad/s; None where velocities are
            not used, because they are estimated from positions: then they are not checked.
    """

    def __init__(
        self,
        position_min: Array,
        position_max: Array,
        velocity_max: Array,
        dt: float,
        position_error: Array,
        velocity_error: Array | None,
    ) -> None:
        speed = np.where(np.isfinite(velocity_max), velocity_max, NO_SPEED_LIMIT)
        width = position_max - position_min
        self._speed = speed
        self._dt, self._gap = dt, max(GAP, 3.0 * dt)
        self._zero = np.zeros_like(speed)
        self._position = POSITION_ERROR + 2.0 * position_error
        error = VELOCITY_ERROR * speed + (0.0 if velocity_error is None else velocity_error)
        self._limits = np.array(
            [
                np.maximum(position_min - width, -FARTHEST),
                np.minimum(position_max + width, FARTHEST),
                np.full_like(speed, np.nan) if velocity_error is None else IMPOSSIBLE * speed,
                FAST * speed,
                self._position,
                # An impact changes a speed from one limit to the other, any time in a period.
                self._position + WINDOW * error + 2.0 * dt * speed,
            ]
        )
        nothing = _Past(State(self._zero, self._zero), 0.0, self._zero)
        self._compare(nothing, nothing.state, dt, 0.0)  # compiled before states come
        self.reset()

    def reset(self) -> None:
        """Forget all states: any state in range may come next."""
        self._newest = -math.inf
        self._accepted: _Past | None = None
        self._doubted: _Past | None = None
        self._since = -math.inf  # when the doubted states began to be plausible, s
        self._reason = ""

    def fault(self, state: State, time: float) -> str:
        """Return why a state is refused, or nothing: then it is accepted.

        Args:
            state: finite, shapes (n,); it is kept.
            time: its stamp, s.
        """
        if time - self._newest > self._gap:
            self.reset()
        elif time <= self._newest:
            return NOT_LATER
        self._newest = time
        before = self._accepted or _Past(state, time, self._zero)
        unseen = 0.0 if self._doubted else time - before.time - self._dt
        reason, after = self._compare(before, state, time, unseen)
        if reason in (OUTSIDE, TOO_FAST):
            self._reason = reason
            return reason
        if not reason and time - before.time <= self._gap:
            return self._accept(after)
        self._reason = reason or self._reason
        if self._doubted is None:
            self._since = time
        else:
            unseen = time - self._doubted.time - self._dt
            reason, after = self._compare(self._doubted, state, time, unseen)
            if reason:
                self._since = time
            elif time - self._since >= WINDOW and self._within_reach(before.state, state):
                return self._accept(after)
        self._doubted = after
        return self._reason

    def _accept(self, past: _Past) -> str:
        self._accepted, self._doubted = past, None
        return ""

    def _within_reach(self, before: State, state: State) -> bool:
        """Return whether an arm that has stopped itself in between can be there."""
        moved = np.abs(state.q - before.q)
        return bool((moved <= self._position + STOPPING * self._speed).all())

    def _compare(self, past: _Past, state: State, time: float, unseen: float) -> tuple[str, _Past]:
        """Return why a state cannot come after another, and what is known after it.

        Args:
            past: the other one.
            state: shapes (n,).
            time: its stamp, s.
            unseen: time between both of which nothing is known, s.
        """
        found, drift = _compared(
            past.state.q, past.state.v, past.drift, state.q, state.v, time - past.time,
            max(unseen, 0.0), self._limits,
        )  # fmt: skip
        return _REASONS[found], _Past(state, time, drift)


_REASONS = ("", CONTRADICTION, JUMP, TOO_FAST, OUTSIDE)


@njit(cache=True)
def _compared(
    q0: Array, v0: Array, drift0: Array, q: Array, v: Array, h: float, unseen: float,
    limits: Array,
) -> tuple[int, Array]:  # fmt: skip
    """Return the index in `_REASONS` of what is wrong with a state, and the drift after it.

    `q0`, `v0` and `drift0` are of the earlier state, `h` is the time between both, `unseen` that
    of which nothing is known. Rows of `limits` bound positions from below and above, speeds (NaN
    where velocities are not used), those of joints that are pushed, errors of positions, and the
    drift. Arrays are of shape (n,), units as above.
    """
    found, drift = 0, np.zeros_like(q)
    for j in range(q.size):
        low, high, impossible, fastest, error, most = limits[:, j]
        moved, speed = q[j] - q0[j], fastest
        if not low <= q[j] <= high:
            found = 4
        if impossible > 0.0:
            if abs(v[j]) > impossible:
                found = max(found, 3)
            speed = max(speed, abs(v[j]))
            drift[j] = math.exp(-h / WINDOW) * drift0[j] + moved - 0.5 * h * (v0[j] + v[j])
        if abs(moved) > error + h * speed:
            found = max(found, 2)
        elif abs(drift[j]) > most + unseen * fastest:
            found = max(found, 1)
        if unseen > 0.0:
            drift[j] = min(max(drift[j], -most), most)
    return found, drift if found == 0 else np.zeros_like(q)
