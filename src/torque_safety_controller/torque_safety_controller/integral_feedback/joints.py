# SPDX-License-Identifier: Apache-2.0
"""Passivity-based integral action that cannot run away: [Benallegue2021], II-B and III-A to C.

Of the torque of a control step,

    tau = M a_ref + h + (C + K) s,   K = lambda diag(M),   s' = a_ref - v',

this is the last term, with s forgotten at two rates, and limited. It is known before the QP is
solved, which then keeps the sum within the torque limits. `docs/integral_action.md` derives it
all, and says where it goes beyond the paper.
"""

from __future__ import annotations

import math
from contextlib import suppress
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from torque_safety_controller.anti_windup import clip, limited_feedback, scale_factor
from torque_safety_controller.integral_feedback.law import WIDENING_TIME, ArmTerms, IntegralLaw
from torque_safety_controller.integral_feedback.leaky_integrator import leak_factors, mix
from torque_safety_controller.integral_feedback.settings import IntegralSettings
from viability_bounds_pkg.exceptions import ArmSafetyError

Array = NDArray[np.float64]

_AMPLIFIED = 10.0  # how much larger than the torque asked for K s may be when initialised


class InitialisationError(ArmSafetyError, ValueError):
    """The integral action cannot be made to give the torque asked for."""


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


class IntegralFeedback(IntegralLaw):
    """Additional torque (C + K) s of one arm.

    Args:
        settings: their number of joints stays.

    Attributes:
        leak: rate at which s is forgotten on top of the leak rates to stay passive, 1/s;
            mostly 0.
    """

    memory: Memory

    def __init__(self, settings: IntegralSettings) -> None:
        self.leak = 0.0
        n = len(settings.budget)
        super().__init__(settings, Memory(*np.zeros((4, n))))
        # The first joint beyond its limit must not find it to be compiled.
        zero, one = np.zeros(n), np.ones(n)
        limited_feedback(zero, zero, settings.mu, np.eye(n), np.zeros((n, n)), one, one)

    @property
    def s(self) -> Array:
        """s~ of eq. (14) that the last torque was computed from, shape (n,), rad/s."""
        return mix(self.memory.fast, self.memory.slow, self.settings.mu)

    def reset(self, arm: ArmTerms) -> None:
        """See `IntegralLaw`."""
        super().reset(arm)
        self.leak = 0.0

    def torque(self, arm: ArmTerms, a_last: Array, dt: float) -> Array:
        """See `IntegralLaw`; s increases by ``a_last dt - (v - v_last)``: (12), (13)."""
        settings, memory = self.settings, self.memory
        torque, saturated, beyond, usable = _advance(
            *memory,
            arm.M,
            arm.C,
            arm.v,
            a_last,
            settings.budget,
            dt,
            settings.gain,
            settings.mu,
            *leak_factors(settings.fast_leak_rate + self.leak, dt, settings.as_printed),
            *leak_factors(settings.slow_leak_rate + self.leak, dt, settings.as_printed),
            math.exp(-dt / WIDENING_TIME),
            settings.as_printed,
        )
        if not usable:
            raise ValueError("dynamics, velocity and acceleration must be finite")
        self.leak, self.saturated = 0.0, saturated
        return self._limited(arm.M, arm.C, torque) if beyond else torque

    def skip(self, arm: ArmTerms, dt: float) -> None:
        """See `IntegralLaw`."""
        super().skip(arm, dt)
        settings, memory = self.settings, self.memory
        self.memory = memory._replace(
            fast=math.exp(-(settings.fast_leak_rate + self.leak) * dt) * memory.fast,
            slow=math.exp(-(settings.slow_leak_rate + self.leak) * dt) * memory.slow,
        )

    def initialise(self, torque: Array, arm: ArmTerms) -> Array:
        """See `IntegralLaw`; it is then forgotten at the slow rate.

        Raises:
            InitialisationError: the torque is not finite, or the arm moves so fast that C + K
                cannot be inverted.
        """
        settings, memory = self.settings, self.memory
        K = settings.gain * np.diagonal(arm.M)
        s: Array = np.full(len(K), np.nan)
        with suppress(np.linalg.LinAlgError):
            s[:] = np.linalg.solve(arm.C + np.diag(K), torque)
        # A NaN is not of sensible size.
        if not np.abs(K * s).max() <= _AMPLIFIED * np.abs(torque).max():
            raise InitialisationError("the arm moves too fast: C + K cannot be inverted")
        fast: Array = memory.fast
        slow: Array = memory.slow
        if settings.mu < 1.0:
            slow = (s - settings.mu * fast) / (1.0 - settings.mu)
        else:
            fast = s
        limited = K * s if settings.as_printed else torque
        widening = np.maximum(np.abs(limited) - settings.budget, 0.0)
        self.memory = Memory(fast, slow, widening, arm.v.copy())
        u, limit = arm.C @ self.s + K * self.s, settings.budget + widening
        self.saturated = np.abs(K * self.s if settings.as_printed else u) > limit
        self.leak = 0.0
        beyond = self.saturated.any() or not np.isfinite(u).all()
        return self._limited(arm.M, arm.C, u) if beyond else u

    def _limited(self, M: Array, C: Array, u: Array) -> Array:
        """Return the torque of integrators that ask for more than their limits: (10), (11).

        With anti-windup ``qp`` the integrators shrink where joints are limited.

        Args:
            M: mass matrix, shape (n, n), kg m^2.
            C: Coriolis matrix, shape (n, n), N m s.
            u: torque (C + K) s, shape (n,), N m: (3), (4), (14).
        """
        settings, memory = self.settings, self.memory
        limit, K = settings.budget + memory.widening, settings.gain * np.diagonal(M)
        if not np.isfinite(u).all():  # beyond floating-point numbers: forget it all
            memory.fast.fill(0.0)
            memory.slow.fill(0.0)
            self.saturated = np.zeros_like(self.saturated)
            return np.zeros_like(u)
        if not settings.as_printed:
            torque, self.leak = limited_feedback(
                memory.fast, memory.slow, settings.mu, M, C, K, limit
            )
            return torque
        Cs, Ks = C @ self.s, K * self.s
        if settings.anti_windup == "scaling":
            return Cs + clip(scale_factor(Ks, limit) * Ks, limit)
        return Cs + clip(Ks, limit)  # which (11) is for a K that is diagonal


@njit(cache=True)
def _advance(
    fast: Array,
    slow: Array,
    widening: Array,
    v_last: Array,
    M: Array,
    C: Array,
    v: Array,
    a_last: Array,
    budget: Array,
    dt: float,
    gain: float,
    mu: float,
    fast_kept: float,
    fast_gain: float,
    slow_kept: float,
    slow_gain: float,
    widening_kept: float,
    as_printed: bool,
) -> tuple[Array, NDArray[np.bool_], bool, bool]:
    """Advance the memory in place, unless something is not finite.

    Returns:
        The torque (C + K) s, which joints are beyond their budgets, shape (n,) each; whether any
        is, or is not finite; whether all that was given is finite.
    """
    n = v.size
    u, beyond, any_beyond = np.zeros(n), np.zeros(n, dtype=np.bool_), False
    for i in range(n):
        usable = math.isfinite(v[i]) and math.isfinite(a_last[i])
        for j in range(n):
            usable = usable and math.isfinite(M[i, j]) and math.isfinite(C[i, j])
        if not usable:
            return u, beyond, False, False
    s = np.empty(n)
    for i in range(n):
        increment = a_last[i] * dt - (v[i] - v_last[i])
        fast[i] = fast_kept * fast[i] + fast_gain * increment
        slow[i] = slow_kept * slow[i] + slow_gain * increment
        widening[i] *= widening_kept
        v_last[i] = v[i]
        s[i] = mu * fast[i] + (1.0 - mu) * slow[i]
    for i in range(n):
        Ks = gain * M[i, i] * s[i]
        for j in range(n):
            u[i] += C[i, j] * s[j]
        u[i] += Ks
        limited, limit = Ks if as_printed else u[i], budget[i] + widening[i]
        beyond[i] = abs(limited) > limit
        any_beyond = any_beyond or beyond[i] or not math.isfinite(u[i])
    return u, beyond, any_beyond, True
