# SPDX-License-Identifier: Apache-2.0
"""Search for the states that leave a joint the least acceleration in each direction.

Two searches that yield what has been found so far, so that a caller can show progress, stop and
keep it: `search_by_sampling` is Algorithm 4 of [DelPrete2018], `search_refined` looks closer
around the worst states.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from scipy.optimize import minimize

from viability_bounds_pkg.estimation.state_space import Array, LimitEstimateError, StateSpace

CHUNK = 2**13
"""States evaluated at once; a power of two, as are the entries of the history."""

NO_INERTIA = 1e-10
"""Below this diagonal entry of M (kg m^2 or kg) a joint is taken to move nothing."""

SAMPLED_SHARE = 0.25
"""Share of the refined search's evaluations spent on random samples."""

SEARCH_STEPS = 30
"""Steps of one local search; most end on a corner of the box before."""

ENOUGH = 1e-4
"""A step that tightens a limit by less than this part ends a local search; others begin."""

CORRECTIONS = 20
"""Steps from which a local search (L-BFGS-B) estimates curvature."""

PATIENCE = 25
"""Rounds of local searches without any gain after which the refined search ends."""


class HistoryEntry(NamedTuple):
    """The estimate after some number of evaluations."""

    evaluations: int
    a_min: Array
    a_max: Array


@dataclass(frozen=True)
class WorstCases:
    """The tightest acceleration limits found, and where.

    Attributes:
        a_min: tightest lower limit of each joint, shape (n,), rad/s^2; not negative where the
            torque cannot always decelerate the joint.
        a_max: tightest upper limit, shape (n,), rad/s^2.
        q_at_a_min: row j is the state that gave ``a_min[j]``, shape (n, n), rad.
        v_at_a_min: its velocity, shape (n, n), rad/s.
        q_at_a_max: row j is the state that gave ``a_max[j]``, shape (n, n), rad.
        v_at_a_max: its velocity, shape (n, n), rad/s.
        evaluations: how often the dynamics were evaluated: once for M and h at a state, once
            more for their derivatives.
        history: how the estimate went on with the evaluations, at about powers of two.
    """

    a_min: Array
    a_max: Array
    q_at_a_min: Array
    v_at_a_min: Array
    q_at_a_max: Array
    v_at_a_max: Array
    evaluations: int
    history: tuple[HistoryEntry, ...]


def torque_terms(model: pin.Model, data: pin.Data, q: Array, v: Array) -> tuple[Array, Array]:
    """Return the bias forces and the diagonal of the inertia matrix of a batch of states.

    Args:
        model: the robot.
        data: of `model`.
        q: positions, shape (batch, n), rad.
        v: velocities, shape (batch, n), rad/s.

    Returns:
        h, shape (batch, n), N m, and the diagonal of M, rotors included, shape (batch, n), kg m^2.
    """
    h, inertia = np.empty(q.shape), np.empty(q.shape)
    for i in range(len(q)):
        inertia[i] = pin.crba(model, data, q[i]).diagonal()
        h[i] = pin.nonLinearEffects(model, data, q[i], v[i])
    return h, inertia


def acceleration_room(
    model: pin.Model, data: pin.Data, space: StateSpace, q: Array, v: Array
) -> Array:
    """Return how far each joint can accelerate up and down with the others at constant speed.

    Lines 9 and 10 of Algorithm 4: ``(tau_max - h) / M[j, j]`` and ``(tau_max + h) / M[j, j]``,
    the second being -a_min, so that less is worse for both.

    Args:
        model: the robot.
        data: of `model`.
        space: torque limits.
        q: positions, shape (batch, n), rad.
        v: velocities, shape (batch, n), rad/s.

    Returns:
        Room upwards and downwards, shape (batch, 2, n), rad/s^2.

    Raises:
        LimitEstimateError: a joint that moves no inertia.
    """
    h, inertia = torque_terms(model, data, q, v)
    if inertia.min() < NO_INERTIA:
        joint = model.names[1 + int(np.argmin(inertia.min(axis=0)))]
        raise LimitEstimateError(
            f"joint {joint} moves no inertia (M[j, j] = {inertia.min():.3g}): "
            "the URDF needs a mass and an inertia on the links it carries"
        )
    return np.stack([(space.tau_max - h) / inertia, (space.tau_max + h) / inertia], axis=1)


class _Tracker:
    """The least room found for each joint and direction, and its state."""

    def __init__(self, n: int):
        self.room = np.full((2, n), np.inf)
        self.q = np.full((2, n, n), np.nan)
        self.v = np.full((2, n, n), np.nan)
        self.evaluations = 0
        self.history: list[HistoryEntry] = []

    def update(self, room: Array, q: Array, v: Array) -> None:
        """Compare rooms, shape (batch, 2, n), of states (batch, n) with the least."""
        self.evaluations += len(room)
        row = np.argmin(room, axis=0)
        least = np.take_along_axis(room, row[None], axis=0)[0]
        better = least < self.room
        self.room[better] = least[better]
        self.q[better] = q[row[better]]
        self.v[better] = v[row[better]]

    def record(self) -> None:
        """Add the present estimate to the history."""
        if not self.history or self.evaluations > self.history[-1].evaluations:
            now = self.snapshot()
            self.history.append(HistoryEntry(now.evaluations, now.a_min, now.a_max))

    def snapshot(self) -> WorstCases:
        """Return what was found so far; later updates do not change it."""
        return WorstCases(
            a_min=-self.room[1],
            a_max=self.room[0].copy(),
            q_at_a_min=self.q[1].copy(),
            v_at_a_min=self.v[1].copy(),
            q_at_a_max=self.q[0].copy(),
            v_at_a_max=self.v[0].copy(),
            evaluations=self.evaluations,
            history=tuple(self.history),
        )


def _chunks(samples: int) -> Iterator[int]:
    """Yield batch sizes that sum to `samples` and end on every power of two on the way."""
    done = 0
    while done < samples:
        size = min(max(done, 1), CHUNK, samples - done)
        yield size
        done += size


def search_by_sampling(
    model: pin.Model, space: StateSpace, samples: int, seed: int
) -> Iterator[WorstCases]:
    """Evaluate uniformly random states: Algorithm 4 of [DelPrete2018].

    The states of a shorter run with the same seed are the first ones of a longer run.

    Args:
        model: the robot.
        space: where states are drawn, and the torque limits.
        samples: how many states (the paper's N).
        seed: of the random generator.

    Yields:
        What has been found so far.

    Raises:
        LimitEstimateError: fewer than one sample, or a joint that moves no inertia.
    """
    if samples < 1:
        raise LimitEstimateError(f"samples must be at least 1, is {samples}")
    rng = np.random.default_rng(seed)
    data = model.createData()
    tracker = _Tracker(space.n)
    for size in _chunks(samples):
        q, v = space.states(rng.random((size, 2 * space.n)))
        tracker.update(acceleration_room(model, data, space, q, v), q, v)
        if tracker.evaluations == samples or tracker.evaluations.bit_count() == 1:
            tracker.record()
        yield tracker.snapshot()


def search_refined(
    model: pin.Model, space: StateSpace, evaluations: int, seed: int
) -> Iterator[WorstCases]:
    """Sample, then descend to a local minimum from the worst states of each limit.

    Every other sample has all velocities at their limits, because h is quadratic in v and its
    extremes lie mostly there. (A Sobol sequence in place of independent samples made no
    difference: 14 dimensions are too many for a few thousand points to fill.) Local searches with
    the analytic derivatives of the inverse dynamics (L-BFGS-B) then start from the worst samples,
    the very worst of each joint and side first, until the evaluations are spent or `PATIENCE`
    rounds over all limits bring nothing.

    As `search_by_sampling`, but `evaluations` is the most evaluations of the dynamics, derivatives
    included.
    """
    if evaluations < 1:
        raise LimitEstimateError(f"samples must be at least 1, is {evaluations}")
    n = space.n
    data = model.createData()
    tracker = _Tracker(n)
    count = 2 ** max(int(evaluations * SAMPLED_SHARE).bit_length() - 1, 0)
    rng = np.random.default_rng(seed)
    points, rooms = [], []
    for size in _chunks(count):
        unit = rng.random((size, 2 * n))
        corner = (tracker.evaluations + np.arange(size)) % 2 == 1
        unit[corner, n:] = np.round(unit[corner, n:])
        q, v = space.states(unit)
        room = acceleration_room(model, data, space, q, v)
        tracker.update(room, q, v)
        tracker.record()
        points.append(unit)
        rooms.append(room.reshape(size, 2 * n))
        yield tracker.snapshot()
    unit = np.concatenate(points)
    order = np.argsort(np.concatenate(rooms), axis=0, kind="stable")
    idle = 0
    for ranks in order:
        before = tracker.room.copy()
        for limit, start in enumerate(ranks):
            _descend(model, data, space, tracker, unit[start], *divmod(limit, n), evaluations)
            yield tracker.snapshot()
        if tracker.evaluations >= 1.2 * tracker.history[-1].evaluations:
            tracker.record()
        idle = 0 if np.any(tracker.room < before - 1e-6 * np.abs(before)) else idle + 1
        if tracker.evaluations + 2 > evaluations or idle == PATIENCE:
            break
    tracker.record()
    yield tracker.snapshot()


class _Spent(Exception):
    """The evaluations allowed are used up."""


def _descend(
    model: pin.Model,
    data: pin.Data,
    space: StateSpace,
    tracker: _Tracker,
    start: Array,
    side: int,
    joint: int,
    evaluations: int,
) -> None:
    """Minimise the room of joint `joint` upwards (side 0) or downwards (1), and tell the tracker.

    From `start`, a point of the unit cube, shape (2 n,), until the tracker has counted
    `evaluations`.
    """
    sign = 1.0 - 2.0 * side
    width = np.concatenate([space.q_max - space.q_min, 2.0 * space.v_max])

    def room_and_slope(unit: Array) -> tuple[float, Array]:
        if tracker.evaluations + 2 > evaluations:
            raise _Spent
        q, v = space.states(unit[None])
        rooms = acceleration_room(model, data, space, q, v)
        tracker.update(rooms, q, v)
        tracker.evaluations += 1
        room = float(rooms[0, side, joint])
        # With a = sign * room, row j of M a + h stays at sign * tau_max as the state moves:
        # M[j, j] d(room) = -sign * d(M a + h)_j at constant a.
        a = np.zeros(space.n)
        a[joint] = sign * room
        by_q, by_v, inertia = pin.computeRNEADerivatives(model, data, q[0], v[0], a)
        change = np.concatenate([by_q[joint], by_v[joint]]) * width
        return room, -sign * change / inertia[joint, joint]

    options = {"maxiter": SEARCH_STEPS, "ftol": ENOUGH, "maxcor": CORRECTIONS}
    bounds = [(0.0, 1.0)] * len(start)
    with contextlib.suppress(_Spent):
        minimize(
            room_and_slope, start, jac=True, method="L-BFGS-B", bounds=bounds, options=options
        )
