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

from torque_safety_controller.anti_windup import clip, nearest_dissipating, scale_factor
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
        super().__init__(settings, Memory(*np.zeros((4, len(settings.budget)))))

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
        fast, slow, torque = _advance(
            memory.fast,
            memory.slow,
            memory.v,
            arm.M,
            arm.C,
            arm.v,
            a_last,
            dt,
            settings.gain,
            settings.mu,
            *leak_factors(settings.fast_leak_rate + self.leak, dt, settings.as_printed),
            *leak_factors(settings.slow_leak_rate + self.leak, dt, settings.as_printed),
        )
        if not np.isfinite(torque).all() and not all(
            np.isfinite(each).all() for each in (arm.M, arm.C, arm.v, a_last)
        ):
            raise ValueError("dynamics, velocity and acceleration must be finite")
        widening = math.exp(-dt / WIDENING_TIME) * memory.widening
        self.memory = Memory(fast, slow, widening, arm.v.copy())
        return self._limited(arm.M, arm.C, torque)

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
        s = self.s
        return self._limited(arm.M, arm.C, arm.C @ s + K * s)

    def _limited(self, M: Array, C: Array, u: Array) -> Array:
        """Return the torque of the integrators, limited: (10), (11).

        With anti-windup ``qp`` the integrators shrink where joints are limited.

        Args:
            M: mass matrix, shape (n, n), kg m^2.
            C: Coriolis matrix, shape (n, n), N m s.
            u: torque (C + K) s, shape (n,), N m: (3), (4), (14).
        """
        settings, memory = self.settings, self.memory
        limit = settings.budget + memory.widening
        self.leak = 0.0
        if not np.isfinite(u).all():  # beyond floating-point numbers: forget it all
            memory.fast.fill(0.0)
            memory.slow.fill(0.0)
            self.saturated = np.zeros_like(self.saturated)
            return np.zeros_like(u)
        if not settings.as_printed:
            self.saturated = np.abs(u) > limit
            return self._qp(M, C, u, limit) if self.saturated.any() else u
        s = self.s
        Cs, Ks = C @ s, settings.gain * np.diagonal(M) * s
        self.saturated = np.abs(Ks) > limit
        if settings.anti_windup == "scaling":
            return Cs + clip(scale_factor(Ks, limit) * Ks, limit)
        return Cs + clip(Ks, limit)  # which (11) is for a K that is diagonal

    def _qp(self, M: Array, C: Array, u: Array, limit: Array) -> Array:
        """Return (11) extended to the whole torque; see `nearest_with_leak`."""
        K = self.settings.gain * np.diagonal(M)
        own = K + np.maximum(np.diagonal(C), 0.0)
        _shrink(self.memory, self.settings.mu, self.s, u - clip(u, limit), own)
        s = self.s
        Cs, Ks = C @ s, K * s
        torque, self.leak = nearest_with_leak(M, s, Cs + Ks, limit, Cs + clip(Ks, limit))
        return torque


@njit(cache=True)
def _advance(
    fast: Array,
    slow: Array,
    v_last: Array,
    M: Array,
    C: Array,
    v: Array,
    a_last: Array,
    dt: float,
    gain: float,
    mu: float,
    fast_kept: float,
    fast_gain: float,
    slow_kept: float,
    slow_gain: float,
) -> tuple[Array, Array, Array]:
    """Return both integrators after a step, and the torque (C + K) s, shape (n,) each."""
    increment = a_last * dt - (v - v_last)
    fast = fast_kept * fast + fast_gain * increment
    slow = slow_kept * slow + slow_gain * increment
    s = mu * fast + (1.0 - mu) * slow
    return fast, slow, C @ s + gain * np.diag(M) * s


def nearest_with_leak(M: Array, s: Array, u: Array, limit: Array, w: Array) -> tuple[Array, float]:
    """Return the torque y of (11) extended by a leak eta of s, and eta, 1/s.

        minimise |y - u|^2 + |eta M s|^2   subject to  |y| <= limit,  s'y + eta s'M s >= s'w.

    A leak damps as the torque eta M s does, without a limit: a solution always exists. In the
    variable f = eta |M s| the leak is one more component of the vector.
    """
    largest = float(np.abs(s).max())
    direction, size, damping = np.zeros_like(s), 0.0, 0.0
    if largest > 0.0:
        direction = s / largest
        momentum = M @ direction
        size = math.sqrt(momentum @ momentum)
        power = direction @ momentum
        damping = float(power / size) if size > 0.0 and power > 0.0 else 0.0
    result = nearest_dissipating(
        np.append(u, 0.0),
        np.append(direction, damping),
        np.append(limit, np.inf),
        float(direction @ w),
    )
    leak = float(result[-1] / (size * largest)) if size * largest > 0.0 else 0.0
    if not (np.isfinite(result).all() and math.isfinite(leak)):
        return clip(u, limit), 0.0
    return result[:-1], leak


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
    outward = np.copysign(1.0, s)
    fast = np.maximum(outward * mu * memory.fast, 0.0)
    slow = np.maximum(outward * (1.0 - mu) * memory.slow, 0.0)
    limited = np.flatnonzero((outward * excess > 0.0) & (own > 0.0) & (fast + slow > 0.0))
    shift = np.minimum(np.abs(excess[limited]) / own[limited], np.abs(s[limited]))
    kept = np.ones_like(s)
    kept[limited] = np.maximum(1.0 - shift / (fast + slow)[limited], 0.0)
    memory.fast[:] *= np.where(fast > 0.0, kept, 1.0)
    memory.slow[:] *= np.where(slow > 0.0, kept, 1.0)
