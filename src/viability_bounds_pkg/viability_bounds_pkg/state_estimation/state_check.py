# SPDX-License-Identifier: Apache-2.0
"""Tells joint states that cannot be: finite, and impossible after those before them.

Between two states that are h apart a joint whose acceleration is at most A cannot leave

    h min(v0, v) - A h^2 / 4 <= q - q0 <= h max(v0, v) + A h^2 / 4

(it is farthest where it gathers speed for half of the time, and loses it). Impacts, at which
speeds jump, keep to it as well. What leaves it by more than errors of the states explain is a
*jump*: joints are swapped, units are others, it is another robot. Over longer times the
trapezoidal rule is far closer, because its errors hardly add up. So

    d(t + h) = exp(-h / WINDOW) d(t) + q - q0 - h (v0 + v) / 2

stays within errors of positions and `WINDOW` times those of speeds, one impact allowed; where it
does not, positions and velocities *contradict* each other: one of them has frozen, or has a bias.

With good sensors `agreement.py` tells it within two states. `leaps.py` remembers what leapt.
"""

from __future__ import annotations

import math

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from viability_bounds_pkg.compiled import bound, compiled
from viability_bounds_pkg.state import State
from viability_bounds_pkg.state_estimation.agreement import APART, Agreement
from viability_bounds_pkg.state_estimation.freeze_check import FROZEN, Expected, FreezeCheck
from viability_bounds_pkg.state_estimation.leaps import (
    STOPS,
    UNSURE,
    Errors,
    Leaps,
    free,
    way_to_rest,
)

Array = NDArray[np.float64]

WINDOW = 0.2
"""Over which positions are compared with velocities, and how long both must agree again, s."""

GAP = 0.1
"""Time between states after which the later one is a beginning, s."""

RESTART = 1.0
"""Time between stamps after which a robot has started again, s."""

SPREAD = 5e-3
"""Error of positions that is not declared and taken for possible, rad: also of stamps, 2.5 ms at
2 rad/s."""

SHARE = 0.05
"""Error of velocities, as a share of the speed limits, taken for possible: filters."""

FAST = 2.0
"""How many times faster than its limit a joint may move, where velocities are not known."""

FORGIVEN = 1.5
"""Time without a contradiction after which the next one is taken for the first, s."""

SPIKE = 0.03
"""Wrong states that end within this time are forgotten at once, s."""

IMPOSSIBLE = 10.0
"""How many times faster than its limit no joint ever moves."""

FAR = 1e6
"""Position that no joint has, also where it has no limits, rad."""

STAYS = 0.05
"""How far an arm that is not believed may have moved besides, rad."""

STUCK = 10.0
"""How long states must agree that are hard to believe, s: where the position of a joint that moved
is still the same, or is farther away than a stop leads."""

LEAP = 0.5
"""Part of the time between states by which stamps leap at least, and error of the leap that is
heard, as a part of it."""

ALIKE = 0.25
"""Part of what positions moved too far that may remain where stamps have leapt instead."""

ONCE_MORE = 4
"""How often a state that is not believed comes again, with its stamp, until it is: a robot that
waits for its answer, as in lockstep, sends no other."""

UNDECIDED = "undecided: an impact, or wrong"
"""Said of a state that the next one decides about."""

UNTIL = f"believed when they leap back, or after a gap of {GAP:g} s in their stamps"
JUMP = f"no motion leads there from the last; {UNTIL}"
EXCHANGED = f"two joints have exchanged their places; {UNTIL}"
CONTRADICTION = "positions contradict velocities"
OUTSIDE = "beyond a limit by more than the range of the joint"
TOO_FAST = f"more than {IMPOSSIBLE:g} times faster than the speed limit"
"""What is wrong with a state."""

SAMPLES = 200
"""Postures in which the largest accelerations are looked for."""


class StateCheck:
    """Looks at the joint states of one arm, one after the other.

    A state that is `UNDECIDED` is neither wrong nor believed: the next one decides.

    After a jump states are believed again at once if they go on within `SPIKE` where the last one
    that was believed leads to. Otherwise, and after a contradiction, they must agree with each
    other for `WINDOW` and show the arm where it can be after a stop. What leapt must have leapt
    back, as joints that are exchanged agree with each other, too; a leap of less than errors of
    positions is believed after `STUCK`. What froze agrees with an arm that stands: after each
    contradiction it takes twice as long, except for states that were the same and change again;
    and `STUCK` while the position of a joint that moved stays the same, or the arm is where no
    stop leads: someone moved it, or weak motors took long. A gap of `GAP` in the stamps, as the
    restart of a robot makes one, is a new beginning.

    Args:
        model: the arm, n joints with one coordinate each.
        position_min: lower position limits, shape (n,), rad; -inf for none.
        position_max: upper ones, shape (n,), rad; inf for none.
        tau_max: torque limits, shape (n,), N m.
        position_error: largest error of positions that is declared, shape (n,), rad.
        velocity_error: of velocities, shape (n,), rad/s; None where velocities are not to be
            looked at.
    """

    def __init__(
        self,
        model: pin.Model,
        position_min: Array,
        position_max: Array,
        tau_max: Array,
        position_error: Array,
        velocity_error: Array | None,
    ) -> None:
        width = position_max - position_min
        limit = np.array(model.velocityLimit)
        limit = np.where((limit > 0.0) & np.isfinite(limit), limit, 10.0)
        known = velocity_error is not None
        error = np.zeros_like(limit) if velocity_error is None else velocity_error
        position, velocity = SPREAD + 2.0 * position_error, SHARE * limit + error
        quarter_a = 0.25 * largest_accelerations(model, tau_max)
        self._errors = Errors(position, velocity, quarter_a, limit, FAST * limit)
        self._with_velocities = known
        # The last state that came, and the one that is looked at, where compiled code reads them.
        self._both = np.zeros((2, 2, model.nv))
        self._before, self._now = (State(q, v) for q, v in self._both)
        self._drift, self._steps = np.zeros((2, model.nv))
        low, high = np.maximum(position_min - width, -FAR), np.minimum(position_max + width, FAR)
        self._nonsense = bound(_nonsense, self._now, low, high, IMPOSSIBLE * limit, known)
        self._passed = bound(_passed, self._before, self._now, known, numbers=3)
        self._compare = bound(
            _compare, self._before, self._now, self._errors, self._drift, known, numbers=2
        )
        self._agreement = Agreement(self._before, self._now, velocity)
        self._leaps = Leaps(self._before, self._now, self._errors, known)
        self._freeze = FreezeCheck(model, tau_max, position, self._before, self._now, known)
        self.reset()

    def reset(self) -> None:
        """Begin anew: any state may come next."""
        self._first, self._sense = True, True  # whether none came before; whether that made sense
        self._time = self._heard = -np.inf  # its time, and when it came, s
        self._believed: tuple[State, float] | None = None
        self._drift.fill(0.0)
        self._agreement.reset()
        self._agreed = 0.0  # how long states have not contradicted each other, s
        self._patience = WINDOW  # how long they must
        self._trusted = 0.0  # how long there has been no doubt, s
        self._doubt = ""
        self._again = 0  # how often the last state has come once more
        self._contradiction = False  # whether it is more than a jump
        self._steps.fill(0.0)  # changes of velocities of an arm that has stopped in doubt, rad/s
        self._freeze.reset()
        self._leaps.clear()

    def expect(self, expected: Expected) -> None:
        """Say how the arm moves from the last state on."""
        self._freeze.expected = expected

    def look(self, state: State, stamp: float, now: float = np.inf) -> str:
        """Look at the next state; return what is wrong, `UNDECIDED`, or nothing.

        Args:
            state: finite, shapes (n,).
            stamp: its time, s.
            now: when it came, on a clock of its own, s; inf if that is not known.
        """
        h = stamp - self._time
        if (self._doubt or self._agreement.undecided) and -GAP <= h <= 0.0:
            same = h == 0.0 and all(map(np.array_equal, self._now, state))
            self._again = self._again + 1 if same else 0
            if self._again < ONCE_MORE:
                return self._doubt or UNDECIDED  # once more, or in another order
            self.reset()
            h = np.inf
        self._again = 0
        self._both[0] = self._both[1]
        self._now.q[:], self._now.v[:] = state
        outside, too_fast = self._nonsense()
        nonsense = OUTSIDE if outside else TOO_FAST if too_fast else ""
        if not 0.0 < h <= GAP:
            self.reset()
        first, sense = self._first, self._sense
        heard, self._heard = now - self._heard, now
        self._first, self._sense, self._time = False, not nonsense, stamp
        if not (first or nonsense) and heard < np.inf:
            h = self._passed(h, heard, APART * self._agreement.period)
        if nonsense:
            np.clip(self._now.q, -FAR, FAR, out=self._now.q)
        if (nonsense or not sense) and not first and self._believed is not None:
            # It leaps, too: exchanged joints, out of each other's range at first, come back to it.
            self._leaps.look(h, self._believed[0].v, nonsense=bool(nonsense))
        if nonsense:
            self._doubt, self._agreed = nonsense, 0.0
            return nonsense
        if first or not sense:
            self._agreed = 0.0
            if not self._doubt:
                self._believed = state, stamp
                return ""
            self._both[0], h = self._both[1], 0.0
        frozen = self._freeze.look(h)
        awakes = self._doubt == FROZEN and self._freeze.changing <= h
        jumps, slowly = self._compare(h, float(awakes))
        contradicts = slowly
        if self._with_velocities:
            apart = self._agreement.contradicts(h, stamp, bool(self._doubt))
            contradicts = contradicts or (apart and not jumps)
        contradicts = contradicts or frozen
        if (jumps or contradicts) and not self._doubt:
            self._agreement.forget_lies()
        self._agreed = 0.0 if jumps or contradicts else self._agreed + h
        if contradicts:
            if not self._contradiction:
                self._patience *= 2.0
            self._contradiction = True
            exchanged = self._agreement.exchanged is not None
            self._doubt = FROZEN if frozen else EXCHANGED if exchanged else CONTRADICTION
        elif jumps and not self._doubt:
            self._doubt = JUMP
        undecided = self._agreement.undecided and not self._doubt
        if not (self._doubt or undecided):
            if self._leaps.follows:
                self._leaps.clear()
        elif self._believed is not None and sense:
            agreement, still = self._agreement, self._doubt == FROZEN
            self._leaps.look(
                h,
                self._believed[0].v,
                agreement.room,
                agreement.exchanged,
                still,
                slowly,
                self._freeze.went_on(),
            )
        if undecided:
            return UNDECIDED
        if self._doubt:
            self._agreement.undecided = False
            if self._believed is not None and stamp - self._believed[1] > STOPS:
                (_, v0), (_, v1) = self._both
                np.maximum(self._steps, np.abs(v1 - v0), out=self._steps)
        if self._doubt and self._goes_on(state, stamp):
            self._doubt, self._contradiction = "", False
            self._steps.fill(0.0)
            self._freeze.believe()
            self._leaps.clear()
        self._trusted = 0.0 if self._doubt else self._trusted + h
        if self._trusted > FORGIVEN:
            self._patience = WINDOW
        if not self._doubt:
            self._believed = state, stamp
        return self._doubt

    def _goes_on(self, state: State, stamp: float) -> bool:
        """Return whether a state may follow that which was believed last."""
        if self._believed is None:
            return self._agreed >= self._patience
        if self._leaps.far:
            return False
        (before, then), errors = self._believed, self._errors
        h, moved = stamp - then, state.q - before.q
        away = self._leaps.away
        if not self._contradiction and h <= SPIKE and not away:
            off = free(errors, h)
            if self._with_velocities:
                low, high = np.minimum(before.v, state.v), np.maximum(before.v, state.v)
            else:
                low, high = -errors.fast, errors.fast
            if ((h * low - off <= moved) & (moved <= h * high + off)).all():
                return True
        off = errors.position + STAYS
        if self._patience > WINDOW or self._leaps.back or not self._with_velocities:
            off = off + STOPS * UNSURE
        moved = moved - self._leaps.thawed
        near = (np.abs(moved) <= way_to_rest(errors, before.v) + off).all()
        # One that still seemed to move after the stop, and does not from one state to the next,
        # stood, and its velocity lied.
        froze = (state.q == before.q) & (self._steps < 0.5 * np.abs(before.v))
        if self._doubt == FROZEN and self._freeze.changing >= WINDOW and near and not away:
            patience = WINDOW
        elif away or not near or (froze & (np.abs(before.v) > errors.velocity)).any():
            patience = max(self._patience, STUCK)
        else:
            patience = self._patience
        return self._agreed >= patience


@compiled
def _nonsense(
    now: State, low: Array, high: Array, fastest: Array, with_velocities: bool
) -> tuple[bool, bool]:
    """Return whether a state is far beyond its limits: of positions, of velocities."""
    outside = too_fast = False
    for i in range(low.size):
        outside = outside or not low[i] <= now.q[i] <= high[i]
        too_fast = too_fast or (with_velocities and abs(now.v[i]) > fastest[i])
    return outside, too_fast


@compiled
def _passed(
    before: State, now: State, with_velocities: bool, h: float, heard: float, least: float
) -> float:
    """Return the time between two states: not h where stamps have leapt.

    That is where the time between the messages that were `heard`, and how far all joints moved at
    their velocities, tell the same other time. It is at `least` about a period: velocities with a
    bias, of an arm that hardly moves, tell hardly any time.
    """
    leap = heard - h
    if not with_velocities or abs(leap) < LEAP * min(h, heard):
        return h
    way = square = 0.0
    for i in range(now.q.size):
        v = 0.5 * (before.v[i] + now.v[i])
        way += v * (now.q[i] - before.q[i])
        square += v * v
    if square == 0.0:
        return h
    passed = way / square
    if passed < least or abs(passed - heard) > LEAP * abs(leap):
        return h
    e = left = 0.0
    for i in range(now.q.size):
        v, moved = 0.5 * (before.v[i] + now.v[i]), now.q[i] - before.q[i]
        e, left = max(e, abs(moved - h * v)), max(left, abs(moved - passed * v))
    return passed if left <= ALIKE * e else h


@compiled
def _compare(
    before: State,
    now: State,
    errors: Errors,
    drift: Array,
    with_velocities: bool,
    h: float,
    begins: float,
) -> tuple[bool, bool]:
    """Return whether no motion leads from one state to the next, and whether they contradict.

    `drift` follows, and is zero where it `begins` anew.
    """
    jumps = contradicts = False
    kept = math.exp(-h / WINDOW)
    for i in range(drift.size):
        moved = now.q[i] - before.q[i]
        # Light wrists could accelerate a thousand times as much as they do: between two states
        # they come no farther than at twice the speed limit.
        between = min(h * h * errors.quarter_a[i], h * errors.limit[i])
        free = errors.position[i] + h * errors.velocity[i] + between
        if with_velocities:
            low, high = min(before.v[i], now.v[i]), max(before.v[i], now.v[i])
        else:
            low, high = -errors.fast[i], errors.fast[i]
        jumps = jumps or moved < h * low - free or moved > h * high + free
        drift[i] = kept * drift[i] + moved - 0.5 * h * (before.v[i] + now.v[i])
        allowed = errors.position[i] + WINDOW * errors.velocity[i] + h * errors.limit[i] + between
        contradicts = contradicts or abs(drift[i]) > allowed
    if jumps or begins or not with_velocities:
        # After a jump the next states are compared among themselves.
        contradicts = False
        drift[:] = 0.0
    elif contradicts:
        drift[:] = 0.0
    return jumps, contradicts


def largest_accelerations(model: pin.Model, tau_max: Array) -> Array:
    """Return what the motors can accelerate joints by at most, shape (n,), rad/s^2.

    All motors together, and as much again for gravity and what is pushed, in the worst of random
    postures: |a| <= 2 |M(q)^-1| tau_max.

    Args:
        model: the arm.
        tau_max: torque limits, shape (n,), N m.
    """
    rng, data, n = np.random.default_rng(0), model.createData(), model.nv
    most = np.zeros(n)
    for _ in range(SAMPLES):
        M = pin.crba(model, data, rng.uniform(-np.pi, np.pi, n))
        most = np.maximum(most, np.abs(np.linalg.inv(M)) @ tau_max)
    return 2.0 * most
