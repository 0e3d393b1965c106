# SPDX-License-Identifier: Apache-2.0
"""Worst-case zero-order hold error of joint accelerations over one control period.

A torque-controlled robot receives a torque that is constant for a period `dt`, so that its
acceleration is not: the inertia and the bias forces of eq. (30) of [DelPrete2018] change on the
way. The paper neglects it ("time steps are typically short"); this module measures it, so that
the acceleration bounds can keep it back as a margin.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from viability_bounds_pkg.estimate.worst_case import Array, LimitEstimateError, StateSpace

SUBSTEPS = 2
"""Runge-Kutta steps a period: their own error is of order (dt / SUBSTEPS)^5."""


@dataclass(frozen=True)
class ZeroOrderHoldError:
    """Worst case over the states searched of motion under held torque against that commanded.

    The torque is the one for the predicted middle of the period, see `mid_step_torque`.

    Attributes:
        dt: the control period, s.
        jerk: sup of abs(da/dt) under held torque, shape (n,), rad/s^3: for a short period the
            error of the acceleration is half of this times `dt`.
        acceleration: sup over t in [0, dt] of abs(a(t) - a), shape (n,), rad/s^2.
        mean_acceleration: sup of abs((v(dt) - v) / dt - a), shape (n,), rad/s^2.
        position: sup of abs(q(dt) - q - v dt - a dt^2 / 2), shape (n,), rad.
        q: the state at which joint j's `acceleration` was found is row j, shape (n, n), rad.
        v: its velocity, shape (n, n), rad/s.
        a: the acceleration asked for there, shape (n, n), rad/s^2.
    """

    dt: float
    jerk: Array
    acceleration: Array
    mean_acceleration: Array
    position: Array
    q: Array
    v: Array
    a: Array


def discretisation_margin(
    model: pin.Model,
    q_min: ArrayLike,
    q_max: ArrayLike,
    v_max: ArrayLike,
    a_min: ArrayLike,
    a_max: ArrayLike,
    tau_max: ArrayLike,
    dt: float,
    samples: int = 20_000,
    seed: int = 0,
    *,
    starts: int = 32,
    rounds: int = 12,
) -> ZeroOrderHoldError:
    """Return the worst zero-order hold error over a period `dt`.

    States and accelerations are drawn within their limits; those that ask for a torque beyond
    `tau_max` are skipped, as the controller does not command them. Random sampling in 3 n
    dimensions stays far below the supremum (by a factor of two and more for seven joints), so
    that a coordinate search goes on from the worst ones: first on the jerk, to which the error
    is proportional for a short `dt` and which costs a tenth, then on the errors themselves. The
    result still bounds the true supremum from below.

    Args:
        model: the robot, one degree of freedom a joint, n of them.
        q_min: lower position limits, shape (n,), rad; infinite for continuous joints.
        q_max: upper position limits, shape (n,), rad.
        v_max: velocity limits, shape (n,), rad/s.
        a_min: lower acceleration limits, shape (n,), rad/s^2.
        a_max: upper acceleration limits, shape (n,), rad/s^2.
        tau_max: torque limits, shape (n,), N m.
        dt: control period, s.
        samples: random states.
        seed: of the random generator.
        starts: worst states, per joint, to search on from.
        rounds: passes of that search over all coordinates; zero for sampling alone.

    Raises:
        LimitEstimateError: limits of the wrong shape, sign or order, a `dt` that is not
            positive, no samples, or no sampled state within the torque limits.
    """
    space = StateSpace.of(model, q_min, q_max, v_max, tau_max)
    n = space.n
    a_min, a_max = (np.asarray(limit, dtype=float) for limit in (a_min, a_max))
    if a_min.shape != (n,) or a_max.shape != (n,) or not np.all(a_min < a_max):
        raise LimitEstimateError(f"a_min and a_max must have {n} values each, a_min < a_max")
    if not (math.isfinite(dt) and dt > 0):
        raise LimitEstimateError(f"dt must be positive, is {dt}")
    if samples < 1:
        raise LimitEstimateError(f"samples must be at least 1, is {samples}")
    lower = np.concatenate([space.q_min, -space.v_max, a_min])
    upper = np.concatenate([space.q_max, space.v_max, a_max])
    rng = np.random.default_rng(seed)
    unit = rng.random((samples, 3 * n))
    # The jerk grows with speed and acceleration: every other sample has them all at a limit.
    unit[::2, n:] = np.round(unit[::2, n:])
    points = lower + unit * (upper - lower)

    def allowed_jerk(points: Array) -> Array:
        tau, jerk = jerk_under_held_torque(model, *np.split(points, 3, axis=1))
        return np.where(np.all(np.abs(tau) <= space.tau_max, axis=1)[:, None], abs(jerk), -np.inf)

    jerks = allowed_jerk(points)
    if not np.isfinite(jerks).any():
        raise LimitEstimateError(
            f"none of {samples} sampled states and accelerations is within the torque limits; "
            "narrow a_min and a_max"
        )
    followed, fastest = climb(allowed_jerk, points, jerks, lower, upper, starts, rounds, rng)

    def allowed_errors(points: Array) -> Array:
        q, v, a = np.split(points, 3, axis=1)
        tau = mid_step_torque(model, q, v, a, dt)
        allowed = np.all(np.abs(tau) <= space.tau_max, axis=1)
        errors = np.full((len(points), 3 * n), -np.inf)
        errors[allowed] = zero_order_hold_error(
            model, q[allowed], v[allowed], a[allowed], tau[allowed], dt
        ).reshape(-1, 3 * n)
        return errors

    # A state on the torque limit at its start may be beyond it in mid-step: keep others.
    begin = np.concatenate([followed, points[: max(100, samples // 10)]])
    errors = allowed_errors(begin)
    best, worst = climb(allowed_errors, begin, errors, lower, upper, 1, min(rounds, 2), rng)
    jerk = fastest.reshape(-1, n).max(axis=0)
    return ZeroOrderHoldError(dt, jerk, *worst.reshape(3, n), *np.split(best[:n], 3, axis=1))


def climb(
    evaluate: Callable[[Array], Array],
    points: Array,
    values: Array,
    lower: Array,
    upper: Array,
    starts: int,
    rounds: int,
    rng: np.random.Generator,
) -> tuple[Array, Array]:
    """Maximise every objective over a box by a coordinate search from the best points known.

    Each coordinate in turn is tried at both its limits, where most maxima of these objectives
    lie, and a random step up and down, which shortens from pass to pass.

    Args:
        evaluate: maps points, shape (batch, d), to objectives, shape (batch, m), with minus
            infinity where a point is not allowed.
        points: where to begin, shape (batch, d).
        values: their objectives, shape (batch, m).
        lower: of the box, shape (d,).
        upper: of the box, shape (d,).
        starts: how many of the best points of each objective are followed.
        rounds: passes over all coordinates.
        rng: source of the steps.

    Returns:
        The points reached, shape (starts * m, d), and the objective each was to maximise, shape
        (starts, m) flattened; with one start, the best point found for every objective.
    """
    order = np.argsort(-values, axis=0)[:starts]
    objective = np.tile(np.arange(values.shape[1]), len(order))
    best = points[order.reshape(-1)]
    best_values = values[order.reshape(-1), objective]
    rows = np.arange(len(best))
    for k in range(rounds):
        reach = 0.3 * 0.03 ** (k / rounds)
        for c in rng.permutation(len(lower)):
            step = np.abs(rng.normal(scale=reach, size=len(best))) * (upper[c] - lower[c])
            proposals = np.repeat(best[None], 4, axis=0)
            proposals[0, :, c] = lower[c]
            proposals[1, :, c] = upper[c]
            proposals[2, :, c] = np.maximum(best[:, c] - step, lower[c])
            proposals[3, :, c] = np.minimum(best[:, c] + step, upper[c])
            scores = evaluate(proposals.reshape(-1, len(lower)))
            scores = scores.reshape(4, len(best), -1)[:, rows, objective]
            choice = np.argmax(scores, axis=0)
            better = scores[choice, rows] > best_values
            best[better] = proposals[choice, rows][better]
            best_values[better] = scores[choice, rows][better]
    return best, best_values


def mid_step_torque(model: pin.Model, q: Array, v: Array, a: Array, dt: float) -> Array:
    """Return the torque for `a` at the middle of a period in which `a` is constant.

    Holding it, the acceleration is off by about half a period times the jerk at the start and,
    the other way, at the end, and right on average to second order in `dt`. Shape (batch, n), N m.
    """
    q_mid = q + 0.5 * dt * v + 0.125 * dt**2 * a
    return _batch(pin.rnea, model, q_mid, v + 0.5 * dt * a, a)


def jerk_under_held_torque(model: pin.Model, q: Array, v: Array, a: Array) -> tuple[Array, Array]:
    """Return the torque for `a` and the jerk while it is held.

    The time derivative of ``M a + h = tau`` at constant tau: ``M da/dt`` is
    ``-(dtau/dq v + dtau/dv a)``, with the partial derivatives of the inverse dynamics. Both are of
    shape (batch, n), N m and rad/s^3.
    """
    data = model.createData()
    tau, drive = np.empty_like(q), np.empty_like(q)
    inertia = np.empty((*q.shape, q.shape[1]))
    for i, (q_i, v_i, a_i) in enumerate(zip(q, v, a, strict=True)):
        by_q, by_v, inertia[i] = pin.computeRNEADerivatives(model, data, q_i, v_i, a_i)
        tau[i] = data.tau
        drive[i] = by_q @ v_i + by_v @ a_i
    return tau, -np.asarray(np.linalg.solve(inertia, drive[..., None])[..., 0], dtype=float)


def zero_order_hold_error(
    model: pin.Model, q: Array, v: Array, a: Array, tau: Array, dt: float, substeps: int = SUBSTEPS
) -> Array:
    """Integrate ``M a + h = tau`` with `tau` held; return the errors of `ZeroOrderHoldError`.

    Those of acceleration, mean acceleration and position, shape (batch, 3, n). Classical
    Runge-Kutta; a(t) is examined where the integrator's steps begin and end, which includes both
    ends of the period, where the error, linear in time to first order, is largest.

    Args:
        model: the robot.
        q: positions at the beginning of a period, shape (batch, n), rad.
        v: velocities, rad/s.
        a: accelerations that are wanted, rad/s^2.
        tau: torques that are held, N m.
        dt: the period, s.
        substeps: steps of the integrator.
    """
    step = dt / substeps
    q_now, v_now = q, v
    error = np.zeros_like(q)
    for _ in range(substeps):
        a_1 = _batch(pin.aba, model, q_now, v_now, tau)
        v_2 = v_now + 0.5 * step * a_1
        a_2 = _batch(pin.aba, model, q_now + 0.5 * step * v_now, v_2, tau)
        v_3 = v_now + 0.5 * step * a_2
        a_3 = _batch(pin.aba, model, q_now + 0.5 * step * v_2, v_3, tau)
        v_4 = v_now + step * a_3
        a_4 = _batch(pin.aba, model, q_now + step * v_3, v_4, tau)
        error = np.maximum(error, np.abs(a_1 - a))
        q_now = q_now + step / 6 * (v_now + 2 * v_2 + 2 * v_3 + v_4)
        v_now = v_now + step / 6 * (a_1 + 2 * a_2 + 2 * a_3 + a_4)
    error = np.maximum(error, np.abs(_batch(pin.aba, model, q_now, v_now, tau) - a))
    mean = np.abs((v_now - v) / dt - a)
    position = np.abs(q_now - q - dt * v - 0.5 * dt**2 * a)
    return np.stack([error, mean, position], axis=1)


def _batch(dynamics: Callable[..., Array], model: pin.Model, *arrays: Array) -> Array:
    """Return one of Pinocchio's algorithms on each row of arrays of shape (batch, n)."""
    data = model.createData()
    result = np.empty(arrays[0].shape)
    for i, row in enumerate(zip(*arrays, strict=True)):
        result[i] = dynamics(model, data, *row)
    return result
