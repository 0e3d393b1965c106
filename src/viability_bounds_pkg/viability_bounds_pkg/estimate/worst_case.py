# SPDX-License-Identifier: Apache-2.0
"""Search for the states in which torque leaves each joint the least acceleration.

Two searches: `search_by_sampling` is Algorithm 4 of [DelPrete2018], `search_refined` looks closer
around the worst states.
"""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import minimize

from viability_bounds_pkg.estimate.torque_terms import Bodies, torque_terms
from viability_bounds_pkg.exceptions import ArmSafetyError

Array = NDArray[np.float64]

CHUNK = 1000
"""States evaluated at once, by one thread."""

NO_INERTIA = 1e-10
"""Below this diagonal entry of M (kg m^2 or kg) a joint is taken to move nothing."""

SAMPLED_SHARE = 0.2
"""Share of the refined search's evaluations spent on random samples."""

DESCENT = {"maxiter": 30, "ftol": 1e-4, "maxcor": 20}
"""Of one local search (L-BFGS-B): most end on a corner of the box before."""

PATIENCE = 25
"""Rounds of local searches without any gain after which the refined search ends."""


class LimitEstimateError(ArmSafetyError, ValueError):
    """Limits cannot be estimated from what was given."""


@dataclass(frozen=True)
class StateSpace:
    """The box of states that limits allow, with the torque available in it.

    Attributes:
        q_min: lower positions, shape (n,), rad; finite.
        q_max: upper positions, shape (n,), rad; finite.
        v_max: velocity limits, shape (n,), rad/s.
        tau_max: torque limits, shape (n,), N m.
    """

    q_min: Array
    q_max: Array
    v_max: Array
    tau_max: Array

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.q_min)

    @classmethod
    def of(
        cls,
        model: pin.Model,
        q_min: ArrayLike,
        q_max: ArrayLike,
        v_max: ArrayLike,
        tau_max: ArrayLike,
    ) -> StateSpace:
        """Return the checked box; a joint without position limits is given one turn, -pi to pi.

        Raises:
            LimitEstimateError: a wrong shape, order or sign, or a value that is not finite; the
                message names the joint.
        """
        if model.nq != model.nv:
            raise LimitEstimateError("every joint of the model must have one coordinate")
        given = {"q_min": q_min, "q_max": q_max, "v_max": v_max, "tau_max": tau_max}
        arrays = {key: np.array(value, dtype=float) for key, value in given.items()}
        for key, array in arrays.items():
            if array.shape != (model.nv,):
                raise LimitEstimateError(
                    f"{key} must have {model.nv} values, one a joint; its shape is {array.shape}"
                )
        low, high, *positive = arrays.values()
        turning = np.isneginf(low) & np.isposinf(high)
        low[turning], high[turning] = -math.pi, math.pi
        ordered = np.isfinite(low) & np.isfinite(high) & (low <= high)
        checks = [
            ("q_min", ordered, "position limits must be finite and in order, or both infinite")
        ]
        for key, array in zip(("v_max", "tau_max"), positive, strict=True):
            usable = np.isfinite(array) & (array > 0.0)
            checks.append((key, usable, f"{key} must be positive and finite"))
        for key, usable, allowed in checks:
            if not usable.all():
                j = int(np.argmin(usable))
                raise LimitEstimateError(
                    f"joint {model.names[1 + j]}: {allowed}; {key} is {arrays[key][j]:g}"
                )
        return cls(**arrays)

    def states(self, unit: Array) -> tuple[Array, Array]:
        """Map points of the unit cube, shape (batch, 2 n), to q and v, shape (batch, n)."""
        q = self.q_min + unit[:, : self.n] * (self.q_max - self.q_min)
        np.minimum(q, self.q_max, out=q)  # 1.0 must not end up a rounding error outside
        v = (2.0 * unit[:, self.n :] - 1.0) * self.v_max
        return q, v


class WorstCases:
    """The tightest acceleration limits found, and where.

    Attributes:
        room: least acceleration found upwards and downwards, shape (2, n), rad/s^2; not positive
            where the torque cannot always accelerate the joint that way.
        q: q[side, j] is the state that gave ``room[side, j]``, shape (2, n, n), rad.
        v: its velocity, shape (2, n, n), rad/s.
        evaluations: how often the dynamics were evaluated: once for M and h at a state, once
            more for their derivatives.
    """

    def __init__(self, n: int):
        self.room = np.full((2, n), np.inf)
        self.q = np.full((2, n, n), np.nan)
        self.v = np.full((2, n, n), np.nan)
        self.evaluations = 0

    @property
    def a_min(self) -> Array:
        """Tightest lower limit of each joint, shape (n,), rad/s^2."""
        return -self.room[1]

    @property
    def a_max(self) -> Array:
        """Tightest upper limit of each joint, shape (n,), rad/s^2."""
        return self.room[0]

    def update(self, room: Array, q: Array, v: Array) -> None:
        """Compare rooms, shape (batch, 2, n), of states (batch, n) with the least."""
        self.evaluations += len(room)
        row = np.argmin(room, axis=0)
        least = np.take_along_axis(room, row[None], axis=0)[0]
        better = least < self.room
        self.room[better] = least[better]
        self.q[better] = q[row[better]]
        self.v[better] = v[row[better]]


def acceleration_room(
    model: pin.Model, bodies: Bodies, space: StateSpace, q: Array, v: Array
) -> Array:
    """Return how far each joint can accelerate up and down with the others at constant speed.

    Lines 9 and 10 of Algorithm 4: ``(tau_max - h) / M[j, j]`` and ``(tau_max + h) / M[j, j]``,
    the second being -a_min, so that less is worse for both. Arguments as of `torque_terms`; shape
    (batch, 2, n), rad/s^2.

    Raises:
        LimitEstimateError: a joint that moves no inertia.
    """
    h, inertia = torque_terms(bodies, q, v)
    if inertia.min() < NO_INERTIA:
        joint = model.names[1 + int(np.argmin(inertia.min(axis=0)))]
        raise LimitEstimateError(
            f"joint {joint} moves no inertia (M[j, j] = {inertia.min():.3g}): "
            "the URDF needs a mass and an inertia on the links it carries"
        )
    return np.stack([(space.tau_max - h) / inertia, (space.tau_max + h) / inertia], axis=1)


def search_by_sampling(
    model: pin.Model,
    space: StateSpace,
    samples: int,
    seed: int,
    progress: Callable[[float], None] = lambda share: None,
) -> WorstCases:
    """Evaluate uniformly random states: Algorithm 4 of [DelPrete2018].

    The states of a shorter run with the same seed are the first ones of a longer run.

    Args:
        model: the robot.
        space: where states are drawn, and the torque limits.
        samples: how many states (the paper's N).
        seed: of the random generator.
        progress: is told the share that is done, again and again.

    Raises:
        LimitEstimateError: fewer than one sample, or a joint that moves no inertia.
    """
    _require_samples(samples)
    bodies = Bodies.of(model)

    def evaluate(first: int) -> tuple[Array, Array, Array]:
        """Return rooms and states of a chunk, whose place in the sequence is its own."""
        generator = np.random.PCG64(seed)
        generator.advance(2 * space.n * first)
        count = min(CHUNK, samples - first)
        q, v = space.states(np.random.Generator(generator).random((count, 2 * space.n)))
        return acceleration_room(model, bodies, space, q, v), q, v

    worst = WorstCases(space.n)
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for found in pool.map(evaluate, range(0, samples, CHUNK)):
            worst.update(*found)
            progress(worst.evaluations / samples)
    return worst


def _require_samples(samples: int) -> None:
    if samples < 1:
        raise LimitEstimateError(f"samples must be at least 1, is {samples}")


def search_refined(
    model: pin.Model,
    space: StateSpace,
    evaluations: int,
    seed: int,
    progress: Callable[[float], None] = lambda share: None,
) -> WorstCases:
    """Sample, then descend to a local minimum from the worst states of each limit.

    Every other sample has all velocities at their limits, because h is quadratic in v and its
    extremes lie mostly there. Local searches with the analytic derivatives of the inverse dynamics
    (L-BFGS-B) then start from the worst samples, the very worst of each joint and side first,
    until the evaluations are spent or `PATIENCE` rounds over all limits bring nothing.

    As `search_by_sampling`, but `evaluations` is the most evaluations of the dynamics, derivatives
    included.
    """
    _require_samples(evaluations)
    n = space.n
    data, bodies = model.createData(), Bodies.of(model)
    worst = WorstCases(n)
    count = max(int(SAMPLED_SHARE * evaluations), 1)
    unit = np.random.default_rng(seed).random((count, 2 * n))
    unit[1::2, n:] = np.round(unit[1::2, n:])
    q, v = space.states(unit)
    room = acceleration_room(model, bodies, space, q, v)
    worst.update(room, q, v)
    idle = 0
    for starts in np.argsort(room.reshape(count, 2 * n), axis=0, kind="stable"):
        before = worst.room.copy()
        for limit, start in enumerate(starts):
            _descend(
                model, data, bodies, space, worst, unit[start], *divmod(limit, n), evaluations
            )
            progress(worst.evaluations / evaluations)
        idle = 0 if np.any(worst.room < before - 1e-6 * np.abs(before)) else idle + 1
        if worst.evaluations + 2 > evaluations or idle == PATIENCE:
            break
    return worst


class _Spent(Exception):
    """The evaluations allowed are used up."""


def _descend(
    model: pin.Model,
    data: pin.Data,
    bodies: Bodies,
    space: StateSpace,
    worst: WorstCases,
    start: Array,
    side: int,
    joint: int,
    evaluations: int,
) -> None:
    """Minimise the room of joint `joint` upwards (side 0) or downwards (1), and update `worst`.

    From `start`, a point of the unit cube, shape (2 n,), until `evaluations` are counted.
    """
    sign = 1.0 - 2.0 * side
    width = np.concatenate([space.q_max - space.q_min, 2.0 * space.v_max])

    def room_and_slope(unit: Array) -> tuple[float, Array]:
        if worst.evaluations + 2 > evaluations:
            raise _Spent
        q, v = space.states(unit[None])
        rooms = acceleration_room(model, bodies, space, q, v)
        worst.update(rooms, q, v)
        worst.evaluations += 1
        room = float(rooms[0, side, joint])
        # With a = sign * room, row j of M a + h stays at sign * tau_max as the state moves:
        # M[j, j] d(room) = -sign * d(M a + h)_j at constant a.
        a = np.zeros(space.n)
        a[joint] = sign * room
        by_q, by_v, inertia = pin.computeRNEADerivatives(model, data, q[0], v[0], a)
        change = np.concatenate([by_q[joint], by_v[joint]]) * width
        return room, -sign * change / inertia[joint, joint]

    bounds = [(0.0, 1.0)] * len(start)
    with contextlib.suppress(_Spent):
        minimize(
            room_and_slope, start, jac=True, method="L-BFGS-B", bounds=bounds, options=DESCENT
        )
