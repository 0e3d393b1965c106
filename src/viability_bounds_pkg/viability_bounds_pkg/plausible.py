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
from numba import njit
from numpy.typing import NDArray

from viability_bounds_pkg.state import State

Array = NDArray[np.float64]

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


class _Tolerances(NamedTuple):
    """What is plausible, arrays of shape (n,).

    Attributes:
        position: what positions may be wrong by, rad.
        velocity: what velocities may be wrong by, rad/s.
        fastest: speed of a joint that is pushed, rad/s.
        drift: by which positions may contradict velocities, rad.
        way_of_same: way of a joint whose position and velocity stay the same, rad.
        way: way of a joint whose position stays the same, rad.
    """

    position: Array
    velocity: Array
    fastest: Array
    drift: Array
    way_of_same: Array
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
        self._low = np.maximum(position_min - width, -FARTHEST)
        self._high = np.minimum(position_max + width, FARTHEST)
        self._v_max, self._gap = fastest, max(GAP, 3.0 * dt)
        self._zero = np.zeros_like(fastest)
        self._uses_velocities = velocity_error is not None
        self._position = POSITION_ERROR + 2.0 * position_error
        velocity = FAST_ENOUGH * fastest + position_error / dt
        if velocity_error is not None:
            velocity = VELOCITY_ERROR * fastest + velocity_error
        self._tolerances = _Tolerances(
            self._position,
            velocity,
            FAST * fastest,
            # An impact, at any moment of a period, changes a speed from one limit to the other.
            self._position + WINDOW * velocity + 2.0 * dt * fastest,
            # A robot may repeat a position once, and a filter let velocities fade after a hit.
            self._position + dt * fastest,
            self._position + max(dt, FILTER) * fastest,
        )
        self._dt = dt
        rest = State(self._zero, self._zero)
        self._compare(self._first(rest, 0.0), rest, dt, 0.0)  # compiled before states come
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
        if not ((self._low <= state.q) & (state.q <= self._high)).all():
            return OUTSIDE
        if self._uses_velocities and (np.abs(state.v) > IMPOSSIBLE * self._v_max).any():
            return TOO_FAST
        return ""

    def _compare(self, past: _Past, state: State, time: float, unseen: float) -> tuple[str, _Past]:
        """Return why a state cannot come after another, and what is known after it.

        Args:
            past: the other one.
            state: shapes (n,).
            time: its stamp, s.
            unseen: time between both of which nothing is known, s.
        """
        found, v, drift, way = _compared(
            *past.state, past.drift, past.way, *state, time - past.time, max(unseen, 0.0),
            self._uses_velocities, self._tolerances,
        )  # fmt: skip
        reason = _REASONS[found]
        if reason == JUMP:
            return reason, self._first(state, time)
        return reason, _Past(State(state.q, v), time, self._zero if reason else drift, way)


_REASONS = ("", CONTRADICTION, FROZEN, JUMP)


@njit(cache=True)
def _compared(
    q0: Array, v0: Array, drift0: Array, way0: Array, q: Array, v: Array, h: float, unseen: float,
    uses_velocities: bool, most: _Tolerances,
) -> tuple[int, Array, Array, Array]:  # fmt: skip
    """Compare a state with an earlier one.

    Args:
        q0: earlier positions, shape (n,), rad.
        v0: earlier velocities, shape (n,), rad/s.
        drift0: see `_Past`, like `way0`.
        way0: likewise.
        q: positions, shape (n,), rad.
        v: velocities, shape (n,), rad/s.
        h: time between both, s.
        unseen: part of it of which nothing is known, s.
        uses_velocities: whether velocities count; else they are found from positions.
        most: what is plausible.

    Returns:
        Index of the worst reason in `_REASONS`; velocities, drift and way now.
    """
    v, drift, way = v.copy(), np.zeros_like(q), np.zeros_like(q)
    none_moves, worst = not uses_velocities and (q == q0).all(), 0
    for j in range(q.size):
        moved, fastest, same = q[j] - q0[j], most.fastest[j], none_moves
        if uses_velocities:
            mean, same = 0.5 * (v0[j] + v[j]), moved == 0.0
            fastest = max(fastest, abs(v[j]))
            drift[j] = math.exp(-h / WINDOW) * drift0[j] + moved - h * mean
        else:
            v[j] = v0[j] if same else v0[j] + SMOOTHING * (moved / h - v0[j])
            mean = v[j]
        if same:
            fast = mean if abs(mean) > most.velocity[j] else 0.0
            way[j] = math.exp(-h / FORGETTING) * way0[j] + h * fast
            way[j] = min(max(way[j], -2.0 * most.way[j]), 2.0 * most.way[j])
        if abs(moved) > most.position[j] + h * fastest:
            worst = 3
        elif abs(way[j]) > (most.way_of_same[j] if v[j] == v0[j] else most.way[j]):
            worst = max(worst, 2)
        elif abs(drift[j]) > most.drift[j] + unseen * most.fastest[j]:
            worst = max(worst, 1)
        if unseen > 0.0:
            drift[j] = min(max(drift[j], -most.drift[j]), most.drift[j])
    return worst, v, drift, way
