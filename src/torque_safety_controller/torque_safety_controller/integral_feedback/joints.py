# SPDX-License-Identifier: Apache-2.0
"""Passivity-based integral action that cannot run away: [Benallegue2021], II-B and III-A to C.

Of the torque of a control step,

    tau = M a_ref + h + (C + K) s,   K = lambda diag(M),   s' = a_ref - v',

this is the last term, with s forgotten at two rates, and limited. It is known before the QP is
solved, which then keeps the sum within the torque limits. `docs/theory/integral_action.md` derives
it all, and says where it goes beyond the paper.
"""

from __future__ import annotations

import math
from contextlib import suppress
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from torque_safety_controller.anti_windup import clip, limited_feedback, scale_factor
from torque_safety_controller.integral_feedback.law import ArmTerms, IntegralLaw
from torque_safety_controller.integral_feedback.leaky_integrator import leak_factors
from torque_safety_controller.integral_feedback.settings import IntegralSettings
from viability_bounds_pkg.exceptions import ArmSafetyError

Array = NDArray[np.float64]

_AMPLIFIED = 10.0  # how much larger than the torque asked for K s may be when initialised


class InitialisationError(ArmSafetyError, ValueError):
    """The integral action cannot be made to give the torque asked for."""


class Memory(NamedTuple):
    """What lasts from one step to the next, shape (n,) each.

    Attributes:
        fast: leaky integral of a_ref - v' with the fast rate, rad/s.
        slow: with the slow rate, rad/s.
        v: velocity that the next increment counts from, rad/s.
    """

    fast: Array
    slow: Array
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
        super().__init__(settings, Memory(*np.zeros((3, len(settings.budget)))))

    @property
    def s(self) -> Array:
        """s~ of eq. (14) that the last torque was computed from, shape (n,), rad/s."""
        mu = self.settings.mu
        return mu * self.memory.fast + (1.0 - mu) * self.memory.slow

    @property
    def leak_rates(self) -> dict[str, float]:
        """See `IntegralLaw`."""
        settings = self.settings
        return {
            "fast": settings.fast_leak_rate + self.leak,
            "slow": settings.slow_leak_rate + self.leak,
        }

    def reset(self, arm: ArmTerms) -> None:
        """See `IntegralLaw`."""
        super().reset(arm)
        self.leak = 0.0

    def torque(self, arm: ArmTerms, a_last: Array, dt: float) -> Array:
        """See `IntegralLaw`; s increases by ``a_last dt - (v - v_last)``: (12), (13).

        At the limits it is (10) or (11); with anti-windup ``qp`` integrators shrink there, too.
        """
        settings, printed = self.settings, self.settings.as_printed
        fast_factors, slow_factors = (
            leak_factors(rate, dt, printed) for rate in self.leak_rates.values()
        )
        fast, slow, torque, saturated, limited, usable = _advance(
            tuple(self.memory),
            (arm.M, arm.C, arm.v),
            a_last,
            dt,
            settings.budget,
            (settings.gain, settings.mu),
            (*fast_factors, *slow_factors),
            printed,
        )
        if not usable:
            raise ValueError("dynamics, velocity and acceleration must be finite")
        self.memory, self.leak, self.saturated = Memory(fast, slow, arm.v.copy()), 0.0, saturated
        if not limited:
            return torque
        if not np.isfinite(torque).all():  # beyond floating-point numbers: forget it all
            self.reset(arm)
            return np.zeros_like(torque)
        K, limit = settings.gain * np.diagonal(arm.M), settings.budget
        if not printed:
            torque, self.leak, fast, slow = limited_feedback(
                fast, slow, settings.mu, arm.M, arm.C, K, limit
            )
            self.memory = self.memory._replace(fast=fast, slow=slow)
            return torque
        Ks = K * self.s
        if settings.anti_windup == "scaling":
            Ks = scale_factor(Ks, limit) * Ks
        return arm.C @ self.s + clip(Ks, limit)  # which (11) is for a K that is diagonal

    def initialise(self, torque: Array, arm: ArmTerms) -> Array:
        """See `IntegralLaw`; it is then forgotten at the slow rate.

        Raises:
            InitialisationError: the torque is not finite, or the arm moves so fast that C + K
                cannot be inverted.
        """
        mu, fast = self.settings.mu, self.memory.fast
        K = self.settings.gain * np.diagonal(arm.M)
        s: Array = np.full(len(K), np.nan)
        with suppress(np.linalg.LinAlgError):
            s[:] = np.linalg.solve(arm.C + np.diag(K), torque)
        # A NaN is not of sensible size.
        if not np.abs(K * s).max() <= _AMPLIFIED * np.abs(torque).max():
            raise InitialisationError("the arm moves too fast: C + K cannot be inverted")
        if mu < 1.0:
            self.memory = Memory(fast, (s - mu * fast) / (1.0 - mu), arm.v.copy())
        else:
            self.memory = Memory(s, self.memory.slow, arm.v.copy())
        return self.torque(arm, np.zeros_like(s), 0.0)


@njit(cache=True)
def _advance(
    memory: tuple[Array, ...],
    arm: tuple[Array, ...],
    a_last: Array,
    dt: float,
    budget: Array,
    numbers: tuple[float, float],
    factors: tuple[float, float, float, float],
    as_printed: bool,
) -> tuple[Array, Array, Array, NDArray[np.bool_], bool, bool]:
    """Return the memory after a step, and its torque before limits.

    Args:
        memory: of the last step, see `Memory`.
        arm: M and C, shape (n, n), and v, shape (n,).
        a_last: acceleration commanded in the last step, shape (n,), rad/s^2.
        dt: time since, s.
        budget: shape (n,), N m.
        numbers: gain lambda, 1/s, and weight mu of the fast integral.
        factors: of the fast integral and then of the slow one, see `leak_factors`.
        as_printed: whether budgets are for K s only.

    Returns:
        The fast and the slow integral, the torque (C + K) s, which joints are beyond their
        budgets, shape (n,) each; whether any is, or is not finite; whether all that was given is
        finite.
    """
    fast_last, slow_last, v_last = memory
    M, C, v = arm
    gain, mu = numbers
    fast_kept, fast_gain, slow_kept, slow_gain = factors
    n = v.size
    fast, slow, u, s = np.empty(n), np.empty(n), np.zeros(n), np.empty(n)
    beyond, limited, usable = np.zeros(n, dtype=np.bool_), False, True
    for i in range(n):
        increment = a_last[i] * dt - (v[i] - v_last[i])
        fast[i] = fast_kept * fast_last[i] + fast_gain * increment
        slow[i] = slow_kept * slow_last[i] + slow_gain * increment
        s[i] = mu * fast[i] + (1.0 - mu) * slow[i]
        usable = usable and math.isfinite(v[i]) and math.isfinite(a_last[i])
    for i in range(n):
        Ks = gain * M[i, i] * s[i]
        for j in range(n):
            u[i] += C[i, j] * s[j]
            usable = usable and math.isfinite(M[i, j]) and math.isfinite(C[i, j])
        u[i] += Ks
        beyond[i] = abs(Ks if as_printed else u[i]) > budget[i]
        limited = limited or beyond[i] or not math.isfinite(u[i])
    return fast, slow, u, beyond, limited, usable
