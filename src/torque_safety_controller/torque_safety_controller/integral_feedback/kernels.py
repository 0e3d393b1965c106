"""One step of the integral action, compiled; `docs/integral_action.md` derives it."""

from __future__ import annotations

import math

import numpy as np

from torque_safety_controller.integral_feedback.anti_windup_kernels import (
    all_finite,
    clip,
    nearest,
    project,
    scale_factor,
)
from torque_safety_controller.integral_feedback.leaky_integrator import leak_factors
from viability_bounds_pkg.compiled import compiled

NONE, CLIP, SCALING, QP = range(4)
"""Ways to limit the torque, in the order of `integral_settings.METHODS`."""

FAST, SLOW, V_LAST, WIDENING = range(4)
"""Rows of the memory: leaky integrals and velocity, rad/s; widening of the budgets, N m."""

S, GAIN_TORQUE, LIMITED_GAIN_TORQUE, TORQUE, SATURATED = range(5)
"""Rows of the report: s, rad/s; K s, what is left of it, and the additional torque, N m."""

LEAK, FACTOR = range(2)
"""Of the scalars: rate of forgetting on top of theta, 1/s, and lambda_w."""


@compiled
def usable(M: np.ndarray, C: np.ndarray, v: np.ndarray, a_ref: np.ndarray, dt: float) -> bool:
    """Return whether all is finite and dt >= 0."""
    total = 0.0
    for i in range(len(v)):
        total += 0.0 * v[i] + 0.0 * a_ref[i]
        for j in range(len(v)):
            total += 0.0 * M[i, j] + 0.0 * C[i, j]
    return total == 0.0 and 0.0 <= dt < math.inf


@compiled
def advance(
    memory: np.ndarray,
    scalars: np.ndarray,
    v: np.ndarray,
    a_ref: np.ndarray,
    dt: float,
    theta_fast: float,
    theta_slow: float,
    paper_form: bool,
    widening_time: float,
) -> None:
    """Take the increment of s, ``a_ref dt - (v - v_last)``, into both integrators: (12)-(13)."""
    leak = scalars[LEAK]
    fast, fast_gain = leak_factors(theta_fast + leak, dt, paper_form)
    slow, slow_gain = leak_factors(theta_slow + leak, dt, paper_form)
    narrowing = math.exp(-dt / widening_time)
    for i in range(len(v)):
        increment = a_ref[i] * dt - (v[i] - memory[V_LAST, i])
        memory[FAST, i] = fast * memory[FAST, i] + fast_gain * increment
        memory[SLOW, i] = slow * memory[SLOW, i] + slow_gain * increment
        memory[V_LAST, i] = v[i]
        memory[WIDENING, i] *= narrowing


@compiled
def evaluate(
    M: np.ndarray,
    C: np.ndarray,
    memory: np.ndarray,
    scalars: np.ndarray,
    report: np.ndarray,
    budget: np.ndarray,
    gain: float,
    mu: float,
    method: int,
    whole_torque: bool,
    correct_state: bool,
) -> None:
    """Compute the additional torque from the integrators, limited: (3), (4), (14); in place."""
    n = len(budget)
    s, x, y = report[S], report[LIMITED_GAIN_TORQUE], report[TORQUE]
    K, Cs, limit, cut = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    s[:] = mix(memory, mu)
    _multiply(C, s, Cs)
    for i in range(n):
        K[i] = gain * M[i, i]
        limit[i] = budget[i] + memory[WIDENING, i]
    Ks = K * s
    u = Cs + Ks
    report[GAIN_TORQUE], report[SATURATED] = Ks, 0.0
    scalars[LEAK], scalars[FACTOR] = 0.0, 1.0
    if not (all_finite(Ks) and all_finite(u)):
        # Beyond floating-point numbers: forget it all.
        memory[FAST], memory[SLOW], report[:] = 0.0, 0.0, 0.0
        return
    asked = u if whole_torque else Ks
    if method == NONE or scale_factor(asked, limit) == 1.0:
        x[:], y[:] = Ks, u
        return
    for i in range(n):
        report[SATURATED, i] = 1.0 if abs(asked[i]) > limit[i] else 0.0
    scalars[FACTOR] = scale_factor(asked if method == SCALING else Ks, limit)
    if correct_state:
        # What others do for a joint, as (11) has it, is nothing to shrink its integral for.
        _limit(s, asked, limit, CLIP if method == QP else method, cut)
        own = K + np.maximum(np.diag(C), 0.0) if whole_torque else K
        _shrink(memory, mu, s, asked - cut, own)
        s[:] = mix(memory, mu)
        _multiply(C, s, Cs)
        Ks = K * s
        u = Cs + Ks
    _limit(s, Ks, limit, method, x)
    if not whole_torque:
        y[:] = Cs + x
        return
    if method == QP:
        scalars[LEAK] = _nearest_with_leak(M, s, u, limit, Cs + x, y)
    else:
        _limit(s, u, limit, method, y)
    if method == SCALING:
        scalars[LEAK] = _leak_of_scaling(M, s, Cs, scale_factor(u, limit))
    x[:] = y - Cs


@compiled
def mix(memory: np.ndarray, mu: float) -> np.ndarray:
    """Return s~ of eq. (14), shape (n,)."""
    return mu * memory[FAST] + (1.0 - mu) * memory[SLOW]


@compiled
def _limit(s: np.ndarray, u: np.ndarray, limit: np.ndarray, method: int, x: np.ndarray) -> None:
    """Fill `x` with `u` limited by (10), (11) or component by component."""
    if method == QP:
        project(u, s, limit, x)
    else:
        x[:] = scale_factor(u, limit) * u if method == SCALING else u
        clip(x, limit, x)


@compiled
def _multiply(A: np.ndarray, x: np.ndarray, y: np.ndarray) -> None:
    """Fill `y` with A x."""
    for i in range(len(y)):
        total = 0.0
        for j in range(len(x)):
            total += A[i, j] * x[j]
        y[i] = total


@compiled
def _dot(x: np.ndarray, y: np.ndarray) -> float:
    total = 0.0
    for i in range(len(x)):
        total += x[i] * y[i]
    return total


@compiled
def _nearest_with_leak(
    M: np.ndarray, s: np.ndarray, u: np.ndarray, limit: np.ndarray, w: np.ndarray, y: np.ndarray
) -> float:
    """Fill `y` with the torque of (11) extended by a leak eta of s, and return eta, 1/s.

        minimise |y - u|^2 + |eta M s|^2   subject to  |y| <= limit,  s'y + eta s'M s >= s'w.

    A leak damps as the torque eta M s does, without a limit: a solution always exists. In the
    variable f = eta |M s| the leak is one more component of the vector.
    """
    n = len(s)
    largest = 0.0
    for i in range(n):
        largest = max(largest, abs(s[i]))
    direction, wish, limits = np.zeros(n + 1), np.zeros(n + 1), np.full(n + 1, np.inf)
    reference, momentum, result = np.zeros(n + 1), np.empty(n), np.empty(n + 1)
    wish[:n], limits[:n], reference[:n] = u, limit, w
    if largest > 0.0:
        direction[:n] = s / largest
    _multiply(M, direction[:n], momentum)
    size = math.sqrt(_dot(momentum, momentum))
    if size > 0.0:
        direction[n] = _dot(direction[:n], momentum) / size
    nearest(wish, direction, limits, reference, np.zeros(n + 1), result)
    if not all_finite(result):
        clip(u, limit, y)
        return 0.0
    y[:] = result[:n]
    return _quotient(result[n], size * largest)


@compiled
def _leak_of_scaling(M: np.ndarray, s: np.ndarray, Cs: np.ndarray, factor: float) -> float:
    """Return the leak that makes up for what is lost of C s where it is scaled too, 1/s."""
    Ms = np.empty(len(s))
    _multiply(M, s, Ms)
    return _quotient((1.0 - factor) * _dot(s, Cs), _dot(s, Ms))


@compiled
def _quotient(missing: float, size: float) -> float:
    """Return missing / size; 0 where it is negative, or where s is too small to tell."""
    if not (missing > 0.0 and size > 0.0):
        return 0.0
    leak = missing / size
    return leak if math.isfinite(leak) else 0.0


@compiled
def _shrink(
    memory: np.ndarray, mu: float, s: np.ndarray, excess: np.ndarray, own: np.ndarray
) -> None:
    """Shrink the integrators of each limited joint, until it asks for what it got.

    Only what contributes to s shrinks, and s not beyond zero, so that no integrator grows or
    changes sign: it is a leak of this joint, just as fast as it must be.

    Args:
        memory: shape (4, n), changed in place.
        mu: weight of the fast integrator.
        s: shape (n,), rad/s.
        excess: by how much the torque asked for is beyond the limit, shape (n,), N m.
        own: torque that a joint asks for by its own s, shape (n,), N m s/rad.
    """
    for i in range(len(s)):
        outward = math.copysign(1.0, s[i])
        fast = max(outward * mu * memory[FAST, i], 0.0)
        slow = max(outward * (1.0 - mu) * memory[SLOW, i], 0.0)
        if outward * excess[i] > 0.0 and own[i] > 0.0 and fast + slow > 0.0:
            shift = min(abs(excess[i]) / own[i], abs(s[i]))
            kept = max(1.0 - shift / (fast + slow), 0.0)
            if fast > 0.0:
                memory[FAST, i] *= kept
            if slow > 0.0:
                memory[SLOW, i] *= kept
