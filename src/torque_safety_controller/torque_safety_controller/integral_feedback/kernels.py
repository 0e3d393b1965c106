# SPDX-License-Identifier: Apache-2.0
"""One step of the joints' integral action, compiled; `docs/integral_action.md` derives it.

[Benallegue2021] allows any positive definite gain K and takes lambda diag(M). With that, (11) is
the clip of each component by itself; with lambda M it is not.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torque_safety_controller.anti_windup import (
    clip,
    nearest_dissipating,
    project,
    scale_factor,
)
from torque_safety_controller.integral_feedback.leaky_integrator import leak_factors, mix
from torque_safety_controller.integral_feedback.settings import (
    NONE,
    PAPER_MASS,
    QP,
    SCALING,
    WIDENING_TIME,
    Law,
)
from viability_bounds_pkg.compiled import compiled

Array = NDArray[np.float64]


class Memory(NamedTuple):
    """What lasts from one step to the next, shape (n,) each; written in place.

    Attributes:
        fast: leaky integral of a_ref - v' with the fast rate, rad/s.
        slow: with the slow rate, rad/s.
        widening: what has been added to the budgets, N m.
        v: velocity that the next increment counts from, rad/s.
    """

    fast: Array
    slow: Array
    widening: Array
    v: Array


@compiled
def step(
    memory: Memory,
    law: Law,
    M: Array,
    C: Array,
    v: Array,
    a_last: Array,
    torque: Array,
    saturated: NDArray[np.bool_],
    leak: float,
    dt: float,
) -> float:
    """Take one step: `advance`, then `evaluate`.

    Returns:
        The leak of the next step, 1/s; NaN when something is not finite, and nothing has changed.
    """
    finite = np.isfinite(M).all() and np.isfinite(C).all()
    if not (finite and np.isfinite(v).all() and np.isfinite(a_last).all()):
        return math.nan
    advance(memory, law, leak, v, a_last, dt)
    return evaluate(memory, law, M, C, torque, saturated)


@compiled
def advance(memory: Memory, law: Law, leak: float, v: Array, a_last: Array, dt: float) -> None:
    """Take the increment of s, ``a_last dt - (v - v_last)``, into both integrators: (12), (13).

    Args:
        memory: of the last step.
        law: settings.
        leak: rate of forgetting on top of the two, 1/s.
        v: shape (n,), rad/s.
        a_last: acceleration commanded in the last step, shape (n,), rad/s^2.
        dt: time since the last step, s.
    """
    as_printed = law.method != QP
    fast, fast_gain = leak_factors(law.fast_leak_rate + leak, dt, as_printed)
    slow, slow_gain = leak_factors(law.slow_leak_rate + leak, dt, as_printed)
    increment = a_last * dt - (v - memory.v)
    memory.fast[:] = fast * memory.fast + fast_gain * increment
    memory.slow[:] = slow * memory.slow + slow_gain * increment
    memory.widening[:] = math.exp(-dt / WIDENING_TIME) * memory.widening
    memory.v[:] = v


@compiled
def evaluate(
    memory: Memory, law: Law, M: Array, C: Array, torque: Array, saturated: NDArray[np.bool_]
) -> float:
    """Compute the additional torque from the integrators, limited: (3), (4), (10), (11), (14).

    Args:
        memory: its integrators shrink where joints are limited.
        law: settings.
        M: mass matrix, shape (n, n), kg m^2.
        C: Coriolis matrix, shape (n, n), N m s.
        torque: shape (n,), receives the additional torque, N m.
        saturated: shape (n,), receives which joints asked for more than their limit.

    Returns:
        Rate at which s must be forgotten, on top of both leak rates, to stay passive, 1/s.
    """
    limit = law.budget + memory.widening
    s = mix(memory.fast, memory.slow, law.mu)
    Cs, Ks = C @ s, gain_torque(law, M, s)
    u = Cs + Ks
    if not (np.isfinite(Ks).all() and np.isfinite(u).all()):
        # Beyond floating-point numbers: forget it all.
        memory.fast[:], memory.slow[:], torque[:], saturated[:] = 0.0, 0.0, 0.0, False
        return 0.0
    torque[:] = u
    saturated[:] = np.abs(u if law.method == QP else Ks) > limit
    if law.method == NONE:
        saturated[:] = False
    if not saturated.any():
        return 0.0
    if law.method == SCALING:
        torque[:] = Cs + clip(scale_factor(Ks, limit) * Ks, limit)
        return 0.0
    if law.method != QP:
        torque[:] = Cs + (project(Ks, s, limit) if law.method == PAPER_MASS else clip(Ks, limit))
        return 0.0
    own = law.gain * np.diag(M) + np.maximum(np.diag(C), 0.0)
    _shrink(memory, law.mu, s, u - clip(u, limit), own)
    s = mix(memory.fast, memory.slow, law.mu)
    Cs, Ks = C @ s, gain_torque(law, M, s)
    return nearest_with_leak(M, s, Cs + Ks, limit, Cs + clip(Ks, limit), torque)


@compiled
def nearest_with_leak(M: Array, s: Array, u: Array, limit: Array, w: Array, y: Array) -> float:
    """Fill `y` with the torque of (11) extended by a leak eta of s, and return eta, 1/s.

        minimise |y - u|^2 + |eta M s|^2   subject to  |y| <= limit,  s'y + eta s'M s >= s'w.

    A leak damps as the torque eta M s does, without a limit: a solution always exists. In the
    variable f = eta |M s| the leak is one more component of the vector.
    """
    n = len(s)
    largest = np.abs(s).max()
    direction, wish, limits = np.zeros(n + 1), np.zeros(n + 1), np.full(n + 1, np.inf)
    reference = np.zeros(n + 1)
    wish[:n], limits[:n], reference[:n] = u, limit, w
    size = 0.0
    if largest > 0.0:
        direction[:n] = s / largest
        momentum = M @ direction[:n]
        size = math.sqrt(momentum @ momentum)
        power = direction[:n] @ momentum
        if size > 0.0 and power > 0.0:
            direction[n] = power / size
    result = nearest_dissipating(wish, direction, limits, float(direction @ reference))
    leak = result[n] / (size * largest) if size * largest > 0.0 else 0.0
    if not (np.isfinite(result).all() and math.isfinite(leak)):
        y[:] = clip(u, limit)
        return 0.0
    y[:] = result[:n]
    return float(leak)


@compiled
def _shrink(memory: Memory, mu: float, s: Array, excess: Array, own: Array) -> None:
    """Shrink the integrators of each limited joint, until it asks for what it got.

    Only what contributes to s shrinks, and s not beyond zero, so that no integrator grows or
    changes sign: it is a leak of this joint, just as fast as it must be.

    Args:
        memory: changed in place.
        mu: weight of the fast integrator.
        s: shape (n,), rad/s.
        excess: by how much the torque asked for is beyond the limit, shape (n,), N m.
        own: torque that a joint asks for by its own s, shape (n,), N m s/rad.
    """
    for i in range(len(s)):
        outward = math.copysign(1.0, s[i])
        fast = max(outward * mu * memory.fast[i], 0.0)
        slow = max(outward * (1.0 - mu) * memory.slow[i], 0.0)
        if outward * excess[i] > 0.0 and own[i] > 0.0 and fast + slow > 0.0:
            shift = min(abs(excess[i]) / own[i], abs(s[i]))
            kept = max(1.0 - shift / (fast + slow), 0.0)
            if fast > 0.0:
                memory.fast[i] *= kept
            if slow > 0.0:
                memory.slow[i] *= kept


@compiled
def gain_torque(law: Law, M: Array, s: Array) -> Array:
    """Return K s, shape (n,), N m, for the mass matrix M, shape (n, n), and s, shape (n,)."""
    if law.method == PAPER_MASS:
        return law.gain * (M @ s)
    return law.gain * np.diag(M) * s


@compiled
def gain_matrix(law: Law, M: Array) -> Array:
    """Return K, shape (n, n), N m s, for the mass matrix M, shape (n, n)."""
    if law.method == PAPER_MASS:
        return law.gain * M
    return law.gain * np.diag(np.diag(M))
