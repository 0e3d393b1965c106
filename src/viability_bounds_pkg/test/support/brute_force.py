# SPDX-License-Identifier: Apache-2.0
"""Problem (4) of [DelPrete2018] solved as it is stated, to check the closed forms against.

Nothing here comes from Algorithms 1 to 3 or from `docs/theory/bounds.md`: no stopping distance, no
kernel, no case distinction. A motion is N steps of constant acceleration, eq. (5), and ends at
rest, where it can stay. Everything is linear in the accelerations, so that "maximise a_0 subject
to the limits" is a linear program with a constraint for each of infinitely many times. It is
solved by exchange: keep the limits at some times, find where the resulting parabolas leave the
range (their extrema), add those times, repeat.

Lengths are made dimensionless with the step and a typical acceleration; the solver's feasibility
tolerance is 1e-10 of that. Motions from several states are solved side by side, which is faster.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from joint_cases import one_joint
from scipy.optimize import linprog
from scipy.sparse import coo_matrix

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
    least, most, margin = extreme_accelerations(case, q[:, 0], v[:, 0])
    clear, found = np.abs(margin) > EDGE, np.isfinite(least) & np.isfinite(most)
    wrong = clear & (viable != (margin >= 0.0))
    both = viable & found
    more = np.concatenate([(upper - most)[both], (least - lower)[both]]) / (case[4] - case[3])
    return Comparison(
        compared=both.sum(),
        misjudged=wrong.sum(),
        unsafe=(wrong & viable).sum(),
        undecided=(np.isnan(margin) | (clear & viable & ~found)).sum(),
        difference=np.abs(more).max(initial=-np.inf),
        excess=more.max(initial=-np.inf),
    )


def extreme_accelerations(case, q, v):
    """Return smallest and largest first acceleration of m states, and their margin.

    The margin is how much narrower, or if negative wider, limits the state could keep, in units
    of a dt^2 for positions and a dt for speeds, where a is the larger of the acceleration limits.
    It is 1 at most, and only a bound on itself where it is below zero. Accelerations are nan where
    the state is not viable; all is nan where the solver fails, which it does now and then.
    """
    motions = _Motions(case, q, v)
    # The speed the state starts with is not the program's to choose.
    margin = np.minimum(motions.margin(), motions.v_max - np.abs(motions.v))
    viable = margin >= -VIABLE
    least, most = np.full(len(q), np.nan), np.full(len(q), np.nan)
    least[viable] = _Motions(case, q[viable], v[viable]).extreme(-1.0)
    most[viable] = _Motions(case, q[viable], v[viable]).extreme(1.0)
    return least, most, margin


class _Motions:
    """m motions side by side; variables of each: N accelerations, a margin, N margins of steps.

    The margins are what position and speed keep from their limits, everywhere and in one step.
    For the extreme first acceleration they are zero. But of motions that reach the extreme, one
    is preferred, by a weight that does not matter, that keeps clear of the limits where it can.
    Without that, the exchange would waste its rounds on corners that the motion need not touch.
    """

    def __init__(self, case, q, v):
        q_min, q_max, v_max, a_min, a_max, dt = case
        self.unit = max(-a_min, a_max)
        scale = self.unit * dt**2
        self.m = len(q)
        self.steps = 8 + int(np.ceil(v_max / (min(-a_min, a_max) * dt)))
        self.low, self.high, self.v_max = q_min / scale, q_max / scale, v_max * dt / scale
        self.bounds = np.array([a_min, a_max]) / self.unit
        self.q, self.v = q / scale, v * dt / scale
        grid = np.meshgrid(np.arange(self.m), np.arange(self.steps), [0.5, 1.0], indexing="ij")
        self.cuts = [part.ravel() for part in grid]  # motion, step, part of the step

    def margin(self):
        """Return the margin that can be kept for ever; negative if the limits cannot."""
        cost, bounds = self._free()
        cost[self.steps] = -1.0
        bounds[self.steps] = (-np.inf, 1.0)
        return self._exchange(cost, bounds)[:, self.steps]

    def extreme(self, sign):
        """Return the largest (or, with sign -1, the smallest) first acceleration, rad/s^2."""
        cost, bounds = self._free()
        cost[0] = -sign
        cost[self.steps + 1 :] = -WEIGHT
        bounds[self.steps + 1 :] = (-1e-9, 0.01)
        return self._exchange(cost, bounds)[:, 0] * self.unit

    def _free(self):
        """Return a cost of nothing, and bounds of accelerations alone."""
        bounds = np.zeros((2 * self.steps + 1, 2))
        bounds[: self.steps] = self.bounds
        return np.zeros(2 * self.steps + 1), bounds

    def _exchange(self, cost, bounds):
        """Return the best variables of all motions, shape (m, 2 N + 1)."""
        best, active = np.full((self.m, cost.size), np.nan), np.arange(self.m)
        for _ in range(ROUNDS):
            best[active] = x = self._solve(active, cost, bounds)
            # What some of the times already rule out, all of them rule out.
            ended = np.isnan(x[:, 0]) | (x[:, self.steps] < -VIABLE)
            active = active[~(self._add_cuts(x, active) | ended)]
            if active.size == 0:
                return best
        best[active] = np.nan
        return best

    def _solve(self, active, cost, bounds):
        """Return the best variables of the active motions, with the limits at some times."""
        k, width = active.size, cost.size
        matrix, rhs = self._rows(active)
        at_rest = np.zeros((k, width))
        at_rest[:, : self.steps] = 1.0
        tight = ("primal_feasibility_tolerance", "dual_feasibility_tolerance")
        for attempt in ({}, {"presolve": False}):
            result = linprog(
                np.tile(cost, k),
                A_ub=matrix,
                b_ub=rhs,
                A_eq=self._sparse(at_rest, active, active),
                b_eq=-self.v[active],
                bounds=np.tile(bounds, (k, 1)),
                method="highs",
                options={**dict.fromkeys(tight, TOLERANCE), **attempt},
            )
            if result.status == 0:
                return result.x.reshape(k, width)
        if k == 1:
            return np.full((1, width), np.nan)
        # At such tolerances the solver gives up now and then: find the motion it is about.
        halves = np.array_split(active, 2)
        return np.concatenate([self._solve(half, cost, bounds) for half in halves])

    def _add_cuts(self, x, active):
        """Add the times at which motions leave the range; return which of them do not."""
        a = x[:, : self.steps]
        slack = -np.minimum(x[:, self.steps : self.steps + 1] + x[:, self.steps + 1 :], 0.0)
        v_start = self.v[active, None] + np.cumsum(a, axis=1) - a
        q_start = self.q[active, None] + np.cumsum(v_start + 0.5 * a, axis=1) - v_start - 0.5 * a
        with np.errstate(divide="ignore", invalid="ignore"):
            phase = np.where(a != 0.0, -v_start / a, -1.0)
        inside = (phase > 0.0) & (phase < 1.0)
        phase = np.where(inside, phase, 1.0)
        peak = q_start + phase * v_start + 0.5 * phase**2 * a
        over = np.maximum(peak - self.high, self.low - peak) - slack
        motion, step = np.nonzero(inside & (over > 3.0 * TOLERANCE))
        new = (active[motion], step, phase[motion, step])
        self.cuts = [np.concatenate(pair) for pair in zip(self.cuts, new, strict=True)]
        finished = np.ones(active.size, dtype=bool)
        finished[motion] = False
        return finished

    def _rows(self, active):
        """Return position limits at the cuts, and speed limits, of motions as ``A x <= b``."""
        kept = np.isin(self.cuts[0], active)
        motion, step, phase = (part[kept] for part in self.cuts)
        # q(k + s) = q + (k + s) v + sum over j < k of (k + s - j - 1/2) a_j + s^2 / 2 a_k.
        j = np.arange(self.steps)
        time = (step + phase)[:, None]
        weight = np.where(j < step[:, None], time - j - 0.5, 0.0)
        weight[np.arange(len(step)), step] = 0.5 * phase**2
        free = self.q[motion] + time[:, 0] * self.v[motion]
        blocks = [
            (sign * weight, limit - sign * free, motion, step)
            for sign, limit in ((1.0, self.high), (-1.0, -self.low))
            if np.isfinite(limit)
        ]
        owner, ends = np.repeat(active, self.steps), np.tile(j, active.size)
        sums = np.tile(np.tri(self.steps), (active.size, 1))
        blocks += [
            (sign * sums, self.v_max - sign * self.v[owner], owner, ends) for sign in (1.0, -1.0)
        ]
        weights, rhs, owners, at = (np.concatenate(part) for part in zip(*blocks, strict=True))
        margins = np.hstack([np.ones((len(at), 1)), at[:, None] == j])
        return self._sparse(np.hstack([weights, margins]), owners, active), rhs

    def _sparse(self, weights, owners, active):
        row, column = np.nonzero(weights)
        width = 2 * self.steps + 1
        place = np.searchsorted(active, owners)[row] * width + column
        shape = (len(weights), active.size * width)
        return coo_matrix((weights[row, column], (row, place)), shape).tocsr()
