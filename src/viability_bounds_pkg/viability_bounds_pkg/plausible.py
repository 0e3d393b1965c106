# SPDX-License-Identifier: Apache-2.0
"""Refuses joint states that are physically impossible after those before them.

A state is refused where

- a position is outside its limits by more than their range, or a speed `IMPOSSIBLE` times as
  large as its limit;
- a position has moved by more than `FAST` times the speed limit allows: a jump;
- positions and velocities have contradicted each other over `WINDOW`: with h between two states,

      d(t + h) = exp(-h / WINDOW) d(t) + q - q0 - h (v0 + v) / 2

  is more than what errors, and one impact within h, explain;
- a position stays the same to the last bit while velocities beyond their errors lead away: it has
  frozen. What freezes while the arm is slower is not told. Where velocities are not used, all
  positions must stay the same, and those of the positions before count, above `FAST_ENOUGH`.

Afterwards states are accepted again at once if they follow the last accepted one. Else they must
have been plausible among themselves for `WINDOW`, and no joint may be farther away than it moves
within `STOPPING`. After a gap of `GAP` in the stamps anything in range is accepted: robots that
restart make one.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from viability_bounds_pkg.state import State

Array = NDArray[np.float64]
Mask = NDArray[np.bool_] | np.bool_

WINDOW = 0.2
"""Over which positions are compared with velocities, and how long they must agree again, s."""

FORGETTING = 10.0
"""Time constant with which the way of a joint is forgotten whose position does not change, s: it
may be the velocities that were wrong, of an arm that stands."""

GAP = 0.1
"""Time between states after which the later one is a new beginning, s; three periods at least."""

STOPPING = 0.35
"""How long an arm whose states are refused may move at its speed limits until it stands, s."""

RESTART_GAP = 1.0
"""By how much the stamps of a robot leap that has started again, s."""

POSITION_ERROR = 2e-3
"""Error of positions that need not be declared, rad: 1 ms of the stamps at 2 rad/s."""

VELOCITY_ERROR = 0.05
"""Error of velocities that need not be declared, as a share of the speed limits: filters."""

FAST_ENOUGH = 0.2
"""Speed, as a share of its limit, from which no arm stops to the last bit within some periods."""

SMOOTHING = 1.0 / 3.0
"""Share of the last period in the speed that is known from positions."""

FILTER = 3e-3
"""Time constant of filters of velocities that are told from frozen positions, s."""

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
FROZEN = "a position is frozen, although its joint moves"
NOT_LATER = "not later than the last one"


class _Past(NamedTuple):
    """A state, and what is known of those before it; arrays of shape (n,).

    Attributes:
        state: the last one.
        time: of it, s.
        drift: d, by which positions have moved farther than velocities led, rad.
        way: by the velocities since the position changed last, rad.
    """

    state: State
    time: float
    drift: Array
    way: Array


class PlausibilityCheck:
    """Checks the states of an arm, one after the other.

    Args:
        position_min: lower position limits, shape (n,), rad; -inf for none.
        position_max: upper ones, shape (n,), rad; inf for none.
        velocity_max: speed limits, shape (n,), rad/s; inf for none.
        dt: control period, s.
        position_error: declared error of positions, shape (n,), rad.
        velocity_error: declared error of velocities, shape (n,), rad/s; None where velocities are
            not used, because they are estimated from positions.
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
        fastest = np.where(np.isfinite(velocity_max), velocity_max, NO_SPEED_LIMIT)
        width = position_max - position_min
        low = np.maximum(position_min - width, -FARTHEST)
        high = np.minimum(position_max + width, FARTHEST)
        self._middle, self._half = 0.5 * (low + high), 0.5 * (high - low)
        self._v_max, self._gap = fastest, max(GAP, 3.0 * dt)
        self._fastest, self._zero = FAST * fastest, np.zeros_like(fastest)
        self._uses_velocities = velocity_error is not None
        self._position = POSITION_ERROR + 2.0 * position_error
        self._velocity = FAST_ENOUGH * fastest + position_error / dt
        self._impossible = np.inf if velocity_error is None else IMPOSSIBLE * fastest
        if velocity_error is not None:
            self._velocity = VELOCITY_ERROR * fastest + velocity_error
        # An impact, at any moment of a period, changes a speed from one limit to the other.
        self._drift = self._position + WINDOW * self._velocity + 2.0 * dt * fastest
        # A robot may repeat a position once, and a filter let velocities fade after a hit.
        self._way_of_same = self._position + dt * fastest
        self._way = self._position + max(dt, FILTER) * fastest
        self._dt = dt
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
        if nonsense := self._out_of_range(state):
            self._reason = nonsense
            return nonsense
        if self._accepted is None:
            self._accept(self._first(state, time))
            return ""
        unseen = 0.0 if self._doubted else time - self._accepted.time - self._dt
        reason, after = self._compare(self._accepted, state, time, unseen)
        if not reason and time - self._accepted.time <= self._gap:
            self._accept(after)
            return ""
        self._reason = reason or self._reason
        if self._doubted is None:
            self._since = time
        else:
            unseen = time - self._doubted.time - self._dt
            reason, after = self._compare(self._doubted, state, time, unseen)
            if reason:
                self._since = time
            elif time - self._since >= WINDOW and self._within_reach(self._accepted.state, state):
                self._accept(after)
                return ""
        self._doubted = after
        return self._reason

    def _first(self, state: State, time: float) -> _Past:
        zero = self._zero
        return _Past(state if self._uses_velocities else State(state.q, zero), time, zero, zero)

    def _accept(self, past: _Past) -> None:
        self._accepted, self._doubted = past, None

    def _within_reach(self, before: State, state: State) -> bool:
        """Return whether an arm that has stopped itself in between can be there."""
        moved = np.abs(state.q - before.q)
        return bool((moved <= self._position + STOPPING * self._v_max).all())

    def _out_of_range(self, state: State) -> str:
        outside = np.abs(state.q - self._middle) > self._half
        if (outside | (np.abs(state.v) > self._impossible)).any():
            return OUTSIDE if outside.any() else TOO_FAST
        return ""

    def _compare(self, past: _Past, state: State, time: float, unseen: float) -> tuple[str, _Past]:
        """Return why a state cannot come after another, and what is known after it.

        Args:
            past: the other one.
            state: shapes (n,).
            time: its stamp, s.
            unseen: time between both of which nothing is known, s.
        """
        (q0, v0), (q, v), h = past.state, state, time - past.time
        moved, fastest, drift = q - q0, self._fastest, self._zero
        same = moved == 0.0
        if self._uses_velocities:
            mean = 0.5 * (v0 + v)
            fastest = np.maximum(fastest, np.abs(v))
            drift = math.exp(-h / WINDOW) * past.drift + moved - h * mean
        else:
            same = np.logical_and.reduce(same)
            mean = v = v0 if same else v0 + SMOOTHING * (moved / h - v0)
        way = self._way_since(past, same, h, mean)
        jumps = np.abs(moved) > self._position + h * fastest
        frozen = np.abs(way) > np.where(v == v0, self._way_of_same, self._way)
        room = self._drift if unseen <= 0.0 else self._drift + unseen * self._fastest
        contradicts = np.abs(drift) > room
        if not (jumps | frozen | contradicts).any():
            if unseen > 0.0:
                drift = _limited(drift, self._drift)
            return "", _Past(State(q, v), time, drift, way)
        if jumps.any():
            return JUMP, self._first(state, time)
        reason = FROZEN if frozen.any() else CONTRADICTION
        return reason, _Past(State(q, v), time, self._zero, way)

    def _way_since(self, past: _Past, same: Mask, h: float, mean: Array) -> Array:
        """Return the way by velocities since positions changed, shape (n,), rad."""
        if not np.any(same):
            return self._zero
        way = math.exp(-h / FORGETTING) * past.way
        way = way + h * np.where(np.abs(mean) > self._velocity, mean, 0.0)
        return np.where(same, _limited(way, 2.0 * self._way), 0.0)


def _limited(x: Array, limit: Array) -> Array:
    return np.minimum(np.maximum(x, -limit), limit)
