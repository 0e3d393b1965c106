# SPDX-License-Identifier: Apache-2.0
"""Largest drift of accelerations while a torque is held, and the jerk that torque rates allow.

A torque-controlled robot receives a torque that is constant for a control period, so that its
acceleration is not: the inertia and the bias forces of eq. (30) of [DelPrete2018] change on the
way. The paper neglects it ("time steps are typically short"); here it is searched for, so that
the acceleration bounds can keep it back as a margin (`docs/theory/bounds.md`). Torques that may
change by a rate only must make up for it first; what is left of the rate allows a jerk.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from viability_bounds_pkg.estimate.worst_case import Array, LimitEstimateError, StateSpace


def acceleration_drift(
    model: pin.Model,
    space: StateSpace,
    a_min: ArrayLike,
    a_max: ArrayLike,
    samples: int = 20_000,
    seed: int = 0,
    *,
    starts: int = 32,
    rounds: int = 12,
) -> Array:
    """Return the sup of abs(da/dt) under held torque, shape (n,), rad/s^3.

    Args:
        model: the robot, one degree of freedom a joint, n of them.
        space: the box of its states, and its torque limits.
        a_min: lower acceleration limits, shape (n,), rad/s^2.
        a_max: upper acceleration limits, shape (n,), rad/s^2.
        samples: random states.
        seed: of the random generator.
        starts: worst states, per joint, to search on from.
        rounds: passes of that search over all coordinates; zero for sampling alone.

    Raises:
        LimitEstimateError: acceleration limits of the wrong shape or order, no samples, or none
            within the torque limits.
    """

    def drift(inertia: Array, drive: Array) -> Array:
        return np.abs(np.linalg.solve(inertia, drive[..., None])[..., 0])

    return _largest(model, space, a_min, a_max, drift, samples, seed, starts, rounds)[0]


def jerk_limits(
    model: pin.Model,
    space: StateSpace,
    a_min: ArrayLike,
    a_max: ArrayLike,
    torque_rate_max: ArrayLike,
    samples: int = 20_000,
    seed: int = 0,
) -> Array:
    """Return the jerk that torque rates allow all joints at once, shape (n,), rad/s^3.

    The rate of the torque is ``M da/dt + c``. With s the least of ``(rate - abs(c)) / (abs(M) A)``
    over joints and states, and A the larger acceleration limit of each joint, jerks up to ``s A``
    keep the rates, whatever their signs: all joints reach A after the time 1 / s.

    Args:
        model: the robot, one degree of freedom a joint, n of them.
        space: the box of its states, and its torque limits.
        a_min: lower acceleration limits, shape (n,), rad/s^2.
        a_max: upper acceleration limits, shape (n,), rad/s^2.
        torque_rate_max: shape (n,), N m/s.
        samples: random states.
        seed: of the random generator.

    Raises:
        LimitEstimateError: as of `acceleration_drift`, or a joint is left no jerk.
    """
    rate = np.asarray(torque_rate_max, dtype=float)
    accelerations = np.maximum(-np.asarray(a_min, dtype=float), a_max)

    def lacking(inertia: Array, drive: Array) -> Array:
        return (np.abs(drive) - rate) / (np.abs(inertia) @ accelerations)

    found, states = _largest(model, space, a_min, a_max, lacking, samples, seed)
    j = int(np.argmax(found))
    if found[j] >= 0.0:
        q, v, a = np.split(np.round(states[j], 3), 3)
        raise LimitEstimateError(
            f"joint {model.names[1 + j]}: a torque rate of {rate[j]:g} N m/s is too small to keep "
            f"accelerations at q = {q.tolist()}, v = {v.tolist()}, a = {a.tolist()}; lower the "
            "velocity limits or the accelerations (--cap)"
        )
    return -found[j] * accelerations


def _largest(
    model: pin.Model,
    space: StateSpace,
    a_min: ArrayLike,
    a_max: ArrayLike,
    score: Callable[[Array, Array], Array],
    samples: int,
    seed: int,
    starts: int = 32,
    rounds: int = 12,
) -> tuple[Array, Array]:
    """Return the largest score of each joint, and its state and accelerations.

    States and accelerations are drawn within their limits; those that ask for more torque than
    there is are skipped, as the controller does not command them. Random sampling in 3 n
    dimensions stays far below the supremum (by a factor of two and more for seven joints), so that
    a coordinate search goes on from the worst ones: each coordinate in turn is tried at both its
    limits, where most maxima lie, and a random step up and down, which shortens from pass to pass.
    The result still bounds the true supremum from below.

    Args:
        model: as the others of `acceleration_drift`.
        space: likewise.
        a_min: likewise.
        a_max: likewise.
        score: of mass matrices M, shape (batch, n, n), and ``dtau/dq v + dtau/dv a``, shape
            (batch, n), N m/s.
        samples: likewise.
        seed: likewise.
        starts: likewise.
        rounds: likewise.

    Returns:
        Shapes (n,) and (n, 3 n).
    """
    n = space.n
    a_min, a_max = (np.asarray(limit, dtype=float) for limit in (a_min, a_max))
    if a_min.shape != (n,) or a_max.shape != (n,) or not np.all(a_min < a_max):
        raise LimitEstimateError(f"a_min and a_max must have {n} values each, a_min < a_max")
    if samples < 1:
        raise LimitEstimateError(f"samples must be at least 1, is {samples}")

    def values_of(points: Array) -> Array:
        """Return the scores, shape (batch, n); -inf where the torque is beyond its limits."""
        tau, inertia, drive = _terms(model, *np.split(points, 3, axis=1))
        within = np.all(np.abs(tau) <= space.tau_max, axis=1)
        return np.where(within[:, None], score(inertia, drive), -np.inf)

    lower = np.concatenate([space.q_min, -space.v_max, a_min])
    upper = np.concatenate([space.q_max, space.v_max, a_max])
    rng = np.random.default_rng(seed)
    unit = rng.random((samples, 3 * n))
    # The jerk grows with speed and acceleration: every other sample has them all at a limit.
    unit[::2, n:] = np.round(unit[::2, n:])
    points = lower + unit * (upper - lower)
    values = values_of(points)
    if not np.isfinite(values).any():
        raise LimitEstimateError(
            f"none of {samples} sampled states and accelerations is within the torque limits; "
            "narrow a_min and a_max"
        )
    order = np.argsort(-values, axis=0)[:starts]
    joint = np.tile(np.arange(n), len(order))
    best, largest = points[order.ravel()], values[order.ravel(), joint]
    rows = np.arange(len(best))
    for k in range(rounds):
        reach = 0.3 * 0.03 ** (k / rounds)
        for c in rng.permutation(3 * n):
            step = np.abs(rng.normal(scale=reach, size=len(best))) * (upper[c] - lower[c])
            proposals = np.repeat(best[None], 4, axis=0)
            proposals[0, :, c] = lower[c]
            proposals[1, :, c] = upper[c]
            proposals[2, :, c] = np.maximum(best[:, c] - step, lower[c])
            proposals[3, :, c] = np.minimum(best[:, c] + step, upper[c])
            scores = values_of(proposals.reshape(-1, 3 * n)).reshape(4, -1, n)[:, rows, joint]
            choice = np.argmax(scores, axis=0)
            better = scores[choice, rows] > largest
            best[better] = proposals[choice, rows][better]
            largest[better] = scores[choice, rows][better]
    first = np.argmax(largest.reshape(-1, n), axis=0) * n + np.arange(n)
    return largest[first], best[first]


def jerk_under_held_torque(model: pin.Model, q: Array, v: Array, a: Array) -> tuple[Array, Array]:
    """Return the torque for `a` and the jerk while it is held.

    The time derivative of ``M a + h = tau`` at constant tau: ``M da/dt`` is
    ``-(dtau/dq v + dtau/dv a)``, with the partial derivatives of the inverse dynamics. Both are of
    shape (batch, n), N m and rad/s^3.
    """
    tau, inertia, drive = _terms(model, q, v, a)
    return tau, -np.asarray(np.linalg.solve(inertia, drive[..., None])[..., 0], dtype=float)


def _terms(model: pin.Model, q: Array, v: Array, a: Array) -> tuple[Array, Array, Array]:
    """Return tau, M and ``dtau/dq v + dtau/dv a`` of a batch of states."""
    data = model.createData()
    tau, drive = np.empty_like(q), np.empty_like(q)
    inertia = np.empty((*q.shape, q.shape[1]))
    for i, (q_i, v_i, a_i) in enumerate(zip(q, v, a, strict=True)):
        by_q, by_v, inertia[i] = pin.computeRNEADerivatives(model, data, q_i, v_i, a_i)
        tau[i] = data.tau
        drive[i] = by_q @ v_i + by_v @ a_i
    return tau, inertia, drive
