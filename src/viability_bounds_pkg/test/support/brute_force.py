# SPDX-License-Identifier: Apache-2.0
"""Problem (4) of [DelPrete2018] solved as it is stated, to check the closed forms against.

Nothing here comes from Algorithms 1 to 3 or from `docs/theory/bounds.md`: no stopping distance, no
kernel, no case distinction. A motion is N steps of constant acceleration, eq. (5). Everything is
linear in the accelerations, so that "maximise a_0 subject to the limits" is a linear program
with a constraint for each of infinitely many times. It is solved by exchange: keep the limits at
some times, find where the resulting parabolas leave the range (their extrema), add those times,
repeat. The horizon is bracketed: a motion that need not be continued after N steps gives at
least the true bound (outer), one that must end at rest, where it can stay, at most (inner).

Lengths are made dimensionless with the step and a typical acceleration; the solver's feasibility
tolerance is 1e-10 of that.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linprog
from scipy.sparse import coo_matrix

TOLERANCE = 1e-10
VIABLE = 1e-8
"""A state counts as viable if limits that are wider by this much can be kept."""

ROUNDS = 400
FIRST_PHASES = np.array([0.5, 1.0])


@dataclass(frozen=True)
class BruteForceJoint:
    """Limits of one joint and the step, SI units."""

    q_min: float
    q_max: float
    v_max: float
    a_min: float
    a_max: float
    dt: float


@dataclass(frozen=True)
class Extremes:
    """Smallest and largest first acceleration, shape (m,), rad/s^2; nan where not viable.

    `margin` is how much narrower, or if negative wider, limits the state could keep, in units of
    a dt^2 for positions and a dt for speeds, where a is the larger of the acceleration limits.
    It is 1 at most, and only a bound on itself where it is below zero. Where the solver fails,
    which at such tolerances it does now and then, the result is nan.
    """

    lower: np.ndarray
    upper: np.ndarray
    margin: np.ndarray


def extreme_accelerations(
    joint: BruteForceJoint, q: np.ndarray, v: np.ndarray, steps: int, end_at_rest: bool
) -> Extremes:
    """Solve problem (4) on a finite horizon for m states, side by side.

    Args:
        joint: its limits.
        q: shape (m,), rad.
        v: shape (m,), rad/s.
        steps: horizon N.
        end_at_rest: True for the inner bracket, False for the outer one.
    """
    motions = _Motions(joint, q, v, steps, end_at_rest)
    # The speed the state starts with is not the program's to choose.
    margin = np.minimum(motions.margin(), motions.v_max - np.abs(motions.v))
    viable = margin >= -VIABLE
    lower, upper = np.full(len(q), np.nan), np.full(len(q), np.nan)
    for out, sign in ((upper, 1.0), (lower, -1.0)):
        motions = _Motions(joint, q[viable], v[viable], steps, end_at_rest)
        out[viable] = motions.extreme(sign)
    return Extremes(lower, upper, margin)


class _Motions:
    """m motions side by side; variables of each: N accelerations, a margin, N margins of steps.

    The margins are what position and speed keep from their limits, everywhere and in one step.
    To look for the extreme first acceleration they are zero; but of the motions that reach the
    extreme, one that keeps clear of the limits where it can is examined for times at which it
    leaves the range. Without that, the exchange would waste its rounds on corners that the
    motion need not touch.
    """

    def __init__(self, joint, q, v, steps, end_at_rest):
        self.unit = max(-joint.a_min, joint.a_max)
        scale = self.unit * joint.dt**2
        self.m, self.steps, self.end_at_rest = len(q), steps, end_at_rest
        self.low, self.high = joint.q_min / scale, joint.q_max / scale
        self.v_max = joint.v_max * joint.dt / scale
        self.bounds = np.array([joint.a_min, joint.a_max]) / self.unit
        self.q, self.v = np.asarray(q) / scale, np.asarray(v) * joint.dt / scale
        grid = np.meshgrid(np.arange(self.m), np.arange(steps), FIRST_PHASES, indexing="ij")
        self.cuts = [part.ravel() for part in grid]

    def margin(self) -> np.ndarray:
        """Return the margin that can be kept for ever; negative if the limits cannot.

        Below -`VIABLE` it is only a bound on itself: it is not followed further.
        """
        margin = np.full(self.m, np.nan)
        active = np.arange(self.m)
        for _ in range(ROUNDS):
            x = self._solve(active, "margin")
            margin[active] = x[:, self.steps]
            # What some of the times already rule out, all of them rule out.
            finished = self._add_cuts(x, active) | (margin[active] < -VIABLE)
            active = active[~finished]
            if active.size == 0:
                return margin
        margin[active] = np.nan
        return margin

    def extreme(self, sign: float) -> np.ndarray:
        """Return the largest (or, with sign -1, the smallest) first acceleration, rad/s^2."""
        extreme = np.full(self.m, np.nan)
        active = np.arange(self.m)
        for _ in range(ROUNDS):
            first = self._solve(active, "first", sign)[:, 0]
            active, first = active[np.isfinite(first)], first[np.isfinite(first)]
            x = self._solve(active, "margin", sign, first)
            finished = self._add_cuts(x, active)
            extreme[active] = np.where(finished & np.isfinite(x[:, 0]), first, np.nan)
            active = active[~finished]
            if active.size == 0:
                break
        return extreme * self.unit

    def _solve(self, active, goal, sign=1.0, first=None) -> np.ndarray:
        """Return the best variables of the active motions, shape (k, 2 N + 1)."""
        if active.size == 0:
            return np.empty((0, 2 * self.steps + 1))
        cost = np.zeros((active.size, 2 * self.steps + 1))
        bounds = np.zeros((*cost.shape, 2))
        bounds[:, : self.steps] = self.bounds
        if goal == "first":
            cost[:, 0] = -sign
        elif first is None:
            cost[:, self.steps] = -1.0
            bounds[:, self.steps] = (-np.inf, 1.0)
        else:
            bounds[:, 0] = first[:, None]
            cost[:, self.steps + 1 :] = -1.0
            bounds[:, self.steps + 1 :] = (-1e-9, 1.0)
        matrix, rhs = self._rows(active)
        equality = self._rest(active) if self.end_at_rest else (None, None)
        options = {
            "primal_feasibility_tolerance": TOLERANCE,
            "dual_feasibility_tolerance": TOLERANCE,
        }
        for attempt in ({}, {"presolve": False}):
            result = linprog(
                cost.ravel(),
                A_ub=matrix,
                b_ub=rhs,
                A_eq=equality[0],
                b_eq=equality[1],
                bounds=bounds.reshape(-1, 2),
                method="highs",
                options={**options, **attempt},
            )
            if result.status == 0:
                return result.x.reshape(cost.shape)
        if active.size == 1:
            return np.full(cost.shape, np.nan)
        # At such tolerances the solver gives up now and then: find the motion it is about.
        halves = np.array_split(np.arange(active.size), 2)
        return np.concatenate(
            [
                self._solve(active[half], goal, sign, None if first is None else first[half])
                for half in halves
            ]
        )

    def _add_cuts(self, x: np.ndarray, active: np.ndarray) -> np.ndarray:
        """Add the times at which motions leave the range; return which of them do not."""
        a = x[:, : self.steps]
        slack = -np.minimum(x[:, self.steps : self.steps + 1] + x[:, self.steps + 1 :], 0.0)
        v_start = self.v[active, None] + np.cumsum(a, axis=1) - a
        q_end = self.q[active, None] + np.cumsum(v_start + 0.5 * a, axis=1)
        q_start = q_end - v_start - 0.5 * a
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

    def _rows(self, active: np.ndarray):
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

    def _rest(self, active: np.ndarray):
        """Return "the speed after the last step is zero"."""
        sums = np.zeros((active.size, 2 * self.steps + 1))
        sums[:, : self.steps] = 1.0
        return self._sparse(sums, active, active), -self.v[active]

    def _sparse(self, weights: np.ndarray, owners: np.ndarray, active: np.ndarray):
        row, column = np.nonzero(weights)
        width = 2 * self.steps + 1
        place = np.searchsorted(active, owners)[row] * width + column
        shape = (len(weights), active.size * width)
        return coo_matrix((weights[row, column], (row, place)), shape).tocsr()
