# SPDX-License-Identifier: Apache-2.0
"""Problem (4) of [DelPrete2018] solved as it is stated, to check the closed forms against.

Nothing here comes from Algorithms 1 to 3 or from `docs/theory/bounds.md`: no stopping distance, no
kernel, no case distinction. A motion is N steps of constant acceleration, eq. (5), and ends at
rest, where it can stay. Everything is linear in the accelerations, so that "maximise a_0 subject
to the limits" is a linear program with a constraint for each of infinitely many times. It is
solved by exchange: keep the limits at some times, find where the resulting parabolas leave the
range (their extrema), add those times, repeat.

Lengths are made dimensionless with the step and a typical acceleration; the solver's feasibility
tolerance is 1e-10 of that.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from joint_cases import one_joint
from scipy.optimize import linprog

from viability_bounds_pkg.viability import acceleration_bounds

EXACT = 1e-6
"""Largest error of a bound, as a part of the acceleration range."""

EDGE = 1e-6
"""Margin within which viable states are not told from others."""

TOLERANCE, VIABLE, WEIGHT, ROUNDS = 1e-10, 1e-8, 1e-7, 400


class Comparison(NamedTuple):
    """The closed form beside brute force.

    Attributes:
        compared: states that are viable, and whose bounds were therefore compared.
        misjudged: those further than `EDGE` from the kernel's edge that we call viable and
            brute force does not, or the other way round.
        unsafe: those of them that we call viable and brute force does not.
        undecided: those for which the solver of linear programs gave up.
        difference: largest difference of a bound, as a part of the acceleration range.
        excess: the same of bounds that allow more than brute force does.
    """

    compared: int
    misjudged: int
    unsafe: int
    undecided: int
    difference: float
    excess: float


def compare(case, q, v, bounds=acceleration_bounds) -> Comparison:
    """Compare viability and bounds with problem (4), for columns of states."""
    *limits, dt = case
    lower, upper, viable = (part[:, 0] for part in bounds(q, v, one_joint(*limits), dt))
    found = [extreme_accelerations(case, *state) for state in np.hstack([q, v]).tolist()]
    least, most, margin = np.array(found).T
    clear, solved = np.abs(margin) > EDGE, np.isfinite(least) & np.isfinite(most)
    wrong = clear & (viable != (margin >= 0.0))
    both = viable & solved
    more = np.concatenate([(upper - most)[both], (least - lower)[both]]) / (case[4] - case[3])
    return Comparison(
        compared=both.sum(),
        misjudged=wrong.sum(),
        unsafe=(wrong & viable).sum(),
        undecided=(np.isnan(margin) | (clear & viable & ~solved)).sum(),
        difference=np.abs(more).max(initial=-np.inf),
        excess=more.max(initial=-np.inf),
    )


def extreme_accelerations(case, q, v, last=0.0, change=np.inf):
    """Return the smallest and largest first acceleration of a state, and its margin.

    Where `change` is finite, an acceleration differs from the one before by at most that much, the
    first one from `last`, and the motion ends without acceleration.

    The margin is how much narrower, or if negative wider, limits the state could keep, in units
    of a dt^2 for positions and a dt for speeds, where a is the larger of the acceleration limits.
    It is 1 at most, and only a bound on itself where it is below zero. Accelerations are nan where
    the state is not viable; all is nan where the solver fails.
    """
    motion = _Motion(case, q, v, last, change)
    # The speed the state starts with is not the program's to choose.
    margin = min(motion.margin(), motion.v_max - abs(motion.v))
    if not margin >= -VIABLE:
        return np.nan, np.nan, margin
    return motion.extreme(-1.0), motion.extreme(1.0), margin


class _Motion:
    """A motion; its variables are N accelerations, a margin, and N margins of steps.

    The margins are what position and speed keep from their limits, everywhere and in one step.
    For the extreme first acceleration they are zero. But of motions that reach the extreme, one
    is preferred, by a weight that does not matter, that keeps clear of the limits where it can.
    Without that, the exchange would waste its rounds on corners that the motion need not touch.
    """

    def __init__(self, case, q, v, last, change):
        q_min, q_max, v_max, a_min, a_max, dt = case
        self.unit = max(-a_min, a_max)
        scale = self.unit * dt**2
        self.n = 8 + int(np.ceil(v_max / (min(-a_min, a_max) * dt) + 4.0 * self.unit / change))
        self.low, self.high, self.v_max = q_min / scale, q_max / scale, v_max * dt / scale
        self.a_range = a_min / self.unit, a_max / self.unit
        self.q, self.v = q / scale, v * dt / scale
        self.last, self.change = last / self.unit, change / self.unit
        # Times at which the limits are kept: number of the step, and part of it.
        self.step, self.part = np.repeat(np.arange(self.n), 2), np.tile([0.5, 1.0], self.n)

    def margin(self):
        """Return the margin that can be kept for ever; negative if the limits cannot."""
        cost = np.zeros(2 * self.n + 1)
        cost[self.n] = -1.0
        return self._exchange(cost, (-np.inf, 1.0), (0.0, 0.0))[self.n]

    def extreme(self, sign):
        """Return the largest (or, with sign -1, the smallest) first acceleration, rad/s^2."""
        cost = np.zeros(2 * self.n + 1)
        cost[0], cost[self.n + 1 :] = -sign, -WEIGHT
        return self._exchange(cost, (0.0, 0.0), (-1e-9, 0.01))[0] * self.unit

    def _exchange(self, cost, margin, margins):
        """Return the best variables, where the margins are in these ranges."""
        bounds = [self.a_range] * self.n + [margin] + [margins] * self.n
        for _ in range(ROUNDS):
            x = self._solve(cost, bounds)
            # What some of the times already rule out, all of them rule out.
            if np.isnan(x[0]) or x[self.n] < -VIABLE or not self._add_times(x):
                return x
        return np.full(len(cost), np.nan)

    def _solve(self, cost, bounds):
        """Return the best variables with the limits at the times so far; nan for no solution."""
        # q(k + s) = q + (k + s) v + sum over j < k of (k + s - j - 1/2) a_j + s^2 / 2 a_k.
        step, j, time = self.step, np.arange(self.n), self.step + self.part
        way = np.where(j < step[:, None], time[:, None] - j - 0.5, 0.0)
        way[np.arange(len(step)), step] = 0.5 * self.part**2
        free, gain = self.q + time * self.v, np.tri(self.n)
        speeds = [np.full(self.n, self.v_max - sign * self.v) for sign in (1.0, -1.0)]
        rhs = np.concatenate([self.high - free, free - self.low, *speeds])
        at = np.concatenate([step, step, j, j])
        rows = np.vstack([way, -way, gain, -gain])
        rows = np.hstack([rows, np.ones((len(at), 1)), at[:, None] == j])
        # What changes from step to step, from the last acceleration to none at the end.
        change = np.eye(self.n + 1, self.n) - np.eye(self.n + 1, self.n, -1)
        before = np.zeros(self.n + 1)
        before[0] = self.last
        for sign in (1.0, -1.0):
            rows = np.vstack([rows, np.pad(sign * change, ((0, 0), (0, self.n + 1)))])
            rhs = np.append(rhs, self.change + sign * before)
        exists = np.isfinite(rhs)
        tight = ("primal_feasibility_tolerance", "dual_feasibility_tolerance")
        for attempt in ({}, {"presolve": False}):  # at such tolerances it gives up now and then
            result = linprog(
                cost,
                A_ub=rows[exists],
                b_ub=rhs[exists],
                A_eq=[[1.0] * self.n + [0.0] * (self.n + 1)],  # it ends at rest
                b_eq=[-self.v],
                bounds=bounds,
                method="highs",
                options={**dict.fromkeys(tight, TOLERANCE), **attempt},
            )
            if result.status == 0:
                return result.x
        return np.full(len(cost), np.nan)

    def _add_times(self, x):
        """Add the times at which the motion leaves the range; return whether there are any."""
        a = x[: self.n]
        slack = -np.minimum(x[self.n] + x[self.n + 1 :], 0.0)
        v = self.v + np.cumsum(a) - a  # at the beginning of each step
        q = self.q + np.cumsum(v + 0.5 * a) - v - 0.5 * a
        turn = np.divide(-v, a, out=np.zeros(self.n), where=a != 0.0)
        peak = q + turn * v + 0.5 * turn**2 * a
        over = np.maximum(peak - self.high, self.low - peak) - slack
        new = (turn > 0.0) & (turn < 1.0) & (over > 3.0 * TOLERANCE)
        self.step = np.append(self.step, np.flatnonzero(new))
        self.part = np.append(self.part, turn[new])
        return new.any()
