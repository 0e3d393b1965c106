"""One step of null-space compliance, compiled; `docs/nullspace_compliance.md` derives it."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from torque_safety_controller.integral_feedback.leaky_integrator import leak_factors
from torque_safety_controller.linalg.cholesky import factorise, solve_vector
from torque_safety_controller.linalg.generalized_inverse import (
    DAMPED,
    NOT_POSITIVE_DEFINITE,
    generalized_inverse,
)
from torque_safety_controller.nullspace.law import (
    Law,
    Terms,
    energy_product,
    law_torque,
    split,
    times,
    transpose_times,
)
from torque_safety_controller.nullspace.limit import keep_within
from viability_bounds_pkg.compiled import compiled

FAILED, NEAR_SINGULAR, LIMITED = -1, 1, 2
"""Outcome of a step: failed, or the sum of what applies."""


class Memory(NamedTuple):
    """What lasts from one step to the next; written in place."""

    s: np.ndarray
    """Leaky integral of a_ref - v', shape (n,), rad/s."""
    integral: np.ndarray
    """Leaky integral of J' s, shape (m,)."""
    a: np.ndarray
    """``s - J^+ integral``, eq. (16), shape (n,), rad/s."""
    root: np.ndarray
    """``sqrt(diag M) x``, shape (n,): its square is the fast memory's energy whatever M does."""
    offset: np.ndarray
    """Torque left over from the mode before, shape (n,), N m."""
    widening: np.ndarray
    """Of the budgets, shape (n,), N m."""
    v: np.ndarray
    """Shape (n,), rad/s."""
    J: np.ndarray
    """Shape (m, n)."""
    M: np.ndarray
    """Shape (n, n), kg m^2."""


@compiled
def step(
    memory: Memory,
    law: Law,
    budget: np.ndarray,
    M: np.ndarray,
    C: np.ndarray,
    J: np.ndarray,
    J_dot: np.ndarray,
    v: np.ndarray,
    a_ref: np.ndarray,
    dt: float,
    entering: bool,
    tau: np.ndarray,
) -> int:
    """Take one step; when it fails `memory` is as before.

    Args:
        memory: of the last step.
        law: settings.
        budget: limits of the torque, shape (n,).
        M: mass matrix, shape (n, n).
        C: Coriolis matrix, shape (n, n).
        J: shape (m, n).
        J_dot: shape (m, n).
        v: shape (n,).
        a_ref: acceleration commanded in the last step, shape (n,).
        dt: time since the last step.
        entering: choose the memory such that the torque is what `tau` holds.
        tau: shape (n,), receives the torque.

    Returns:
        `FAILED` when M is not positive definite or something is not finite; else whether J is
        `NEAR_SINGULAR`, plus whether the memory was `LIMITED`.
    """
    m, n = J.shape
    M_dot, K = np.empty((n, n)), np.empty(n)
    for i in range(n):
        K[i] = law.lambda_ * M[i, i]
        for j in range(n):
            M_dot[i, j] = C[i, j] + C[j, i]
    consistent = law.dynamically_consistent
    J_plus, J_plus_dot = np.empty((n, m)), np.empty((n, m))
    found = generalized_inverse(
        J, J_dot, M, M_dot, consistent, True, law.threshold, J_plus, J_plus_dot
    )
    if found == NOT_POSITIVE_DEFINITE:
        return FAILED
    J_bar = J_plus
    if not consistent and (entering or law.theta_null > law.theta_slow):
        J_bar = np.empty((n, m))
        found = generalized_inverse(J, J_dot, M, M_dot, True, False, law.threshold, J_bar, J_bar)
        if found == NOT_POSITIVE_DEFINITE:
            return FAILED
    terms = Terms(M, C, J, J_dot, J_plus, J_plus_dot, J_bar, K)

    if entering:
        a, x = _enter(law, terms, tau)
        s, integral = split(law, terms, a)
    else:
        s, integral, a, x = _advance(memory, law, terms, v, a_ref, dt)
        if not law.keep_integral:
            s, integral = split(law, terms, a)

    limit, offset = np.empty(n), np.empty(n)
    narrowing, fading = math.exp(-dt / law.widening_time), math.exp(-dt / law.blend_time)
    for i in range(n):
        widening = (
            max(abs(tau[i]) - budget[i], 0.0) if entering else memory.widening[i] * narrowing
        )
        limit[i] = budget[i] + widening
    own = law_torque(law, terms, s, integral, a, x)
    limited = keep_within(law, terms, limit, s, integral, a, x, own)
    total = 0.0
    for i in range(n):
        offset[i] = tau[i] - own[i] if entering else fading * memory.offset[i]
        tau[i] = min(max(own[i] + offset[i], -limit[i]), limit[i])
        total += tau[i] + s[i] + a[i] + x[i] + v[i]
    for i in range(m):
        total += integral[i]
    if not math.isfinite(total):
        return FAILED

    memory.s[:] = s
    memory.integral[:] = integral
    memory.a[:] = a
    memory.offset[:] = offset
    memory.v[:] = v
    memory.J[:] = J
    memory.M[:] = M
    for i in range(n):
        memory.root[i] = math.sqrt(M[i, i]) * x[i]
        memory.widening[i] = limit[i] - budget[i] if math.isfinite(limit[i]) else 0.0
    return (NEAR_SINGULAR if found == DAMPED else 0) + (LIMITED if limited else 0)


@compiled
def storage(memory: Memory, law: Law) -> float:
    """Return the energy that is stored: ``a^T M a / 2`` and the fast memory's, J."""
    x = memory.root / np.sqrt(np.diag(memory.M))
    return 0.5 * energy_product(law, memory.M, memory.a, x, memory.a, x)


@compiled
def pause(memory: Memory, law: Law, v: np.ndarray, J: np.ndarray, dt: float) -> None:
    """Let a time pass in which the memory only leaks."""
    decay = math.exp(-law.theta_slow * dt)
    for i in range(len(v)):
        memory.s[i] *= decay
        memory.a[i] *= decay
        memory.root[i] *= decay
        memory.offset[i] *= math.exp(-dt / law.blend_time)
        memory.widening[i] *= math.exp(-dt / law.widening_time)
        memory.v[i] = v[i]
    for i in range(len(memory.integral)):
        memory.integral[i] *= decay
    memory.J[:] = J


@compiled
def _advance(memory, law, terms, v, a_ref, dt):
    """Return the memory after the acceleration error of the last step: s, integral, a, x."""
    m, n = terms.J.shape
    s, integral, a, x = np.empty(n), np.empty(m), np.empty(n), np.empty(n)
    slow, slow_gain = leak_factors(law.theta_slow, dt, False)
    fast, fast_gain = leak_factors(law.theta_fast, dt, False)
    ratio = fast_gain / slow_gain
    middle = np.empty(n)
    for i in range(n):
        left = slow * memory.s[i]
        s[i] = left + slow_gain * (a_ref[i] * dt - (v[i] - memory.v[i]))
        middle[i] = 0.5 * (left + s[i])
    # With the middle of s the product rule is exact: J a grows by the middle of J times the
    # increment of s.
    for i in range(m):
        integral[i] = slow * memory.integral[i]
        for j in range(n):
            integral[i] += (terms.J[i, j] - memory.J[i, j]) * middle[j]
    task = times(terms.J_plus, integral)
    for i in range(n):
        a[i] = s[i] - task[i]
        # The fast memory takes fast_gain of what a gained, of which slow_gain is seen.
        x[i] = (1.0 - ratio) * a[i] + (ratio * slow - fast) * memory.a[i]
        x[i] += fast * memory.root[i] / math.sqrt(terms.M[i, i])
    if law.theta_null > law.theta_slow:
        forgotten = -math.expm1((law.theta_slow - law.theta_null) * dt)
        task = times(terms.J_bar, times(terms.J, a))
        for i in range(n):
            change = forgotten * (a[i] - task[i])
            s[i] -= change
            a[i] -= change
    return s, integral, a, x


@compiled
def _enter(law, terms, tau):
    """Return a and x that hold of `tau` what the slow memory can; the fast memory is empty."""
    m, n = terms.J.shape
    a = np.zeros(n)
    if law.mu < 1.0 and law.free_null_space:
        # The task feels the force F = J_bar^T tau. Where J a = y the slow torque is
        # J^T ((1 - mu) J^+^T K J^+ y), which is J^T F for this y:
        y = transpose_times(terms.J_bar, tau)
        B = np.zeros((m, m))
        for i in range(m):
            for j in range(i + 1):
                for k in range(n):
                    B[i, j] += terms.J_plus[k, i] * terms.K[k] * terms.J_plus[k, j]
                B[i, j] *= 1.0 - law.mu
        if factorise(B):
            solve_vector(B, y)
            a = times(terms.J_bar, y)
    elif law.mu < 1.0:
        for i in range(n):
            a[i] = tau[i] / ((1.0 - law.mu) * terms.K[i])
    return a, a.copy() if law.theta_fast > law.theta_slow else np.zeros(n)
