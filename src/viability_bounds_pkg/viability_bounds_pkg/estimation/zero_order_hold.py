# SPDX-License-Identifier: Apache-2.0
"""The zero-order hold error: how motion differs from constant acceleration under held torque.

Arguments: Pinocchio's model of n joints; at the beginning of a period of dt, s, positions q,
velocities v and the accelerations a that are wanted, shape (batch, n), rad, rad/s, rad/s^2; the
torques tau that are held, shape (batch, n), N m.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pinocchio as pin

from viability_bounds_pkg.estimation.state_space import Array

SUBSTEPS = 2
"""Runge-Kutta steps a period: their own error is of order (dt / SUBSTEPS)^5."""


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

    Classical Runge-Kutta; a(t) is looked at where the integrator's steps begin and end, which
    includes both ends of the period, where the error, linear in time to first order, is largest.

    They are those of acceleration, mean acceleration and position, shape (batch, 3, n).
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
