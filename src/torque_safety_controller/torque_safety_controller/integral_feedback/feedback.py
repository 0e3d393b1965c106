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

import numpy as np
from numpy.typing import NDArray

from torque_safety_controller.integral_feedback.action import ArmTerms, check_time
from torque_safety_controller.integral_feedback.kernels import Memory, advance, evaluate, step
from torque_safety_controller.integral_feedback.leaky_integrator import mix
from torque_safety_controller.integral_feedback.settings import QP, IntegralSettings
from viability_bounds_pkg.exceptions import ArmSafetyError

Array = NDArray[np.float64]

_AMPLIFIED = 10.0  # how much larger than the torque asked for K s may be when initialised


class InitialisationError(ArmSafetyError, ValueError):
    """The integral action cannot be made to give the torque asked for."""


class IntegralFeedback:
    """Additional torque (C + K) s of one arm, an `IntegralAction`.

    Args:
        settings: their number of joints stays.

    Attributes:
        memory: integrators and budgets; the torque continues from it.
        leak: rate at which s is forgotten on top of the leak rates to stay passive, 1/s;
            mostly 0.
        saturated: which joints asked for more than their limit in the last step, shape (n,);
            overwritten by the next.
    """

    def __init__(self, settings: IntegralSettings) -> None:
        n = len(settings.budget)
        self.memory = Memory(*np.zeros((4, n)))
        self.leak = 0.0
        self.saturated = np.zeros(n, dtype=bool)
        self._settings, self._law = settings, settings.law
        # The first call compiles; let it be this one and not one in a control loop.
        zero, square, no_rows = np.zeros(n), np.zeros((n, n)), np.zeros((0, n))
        self.torque(ArmTerms(np.eye(n), square, no_rows, no_rows, zero), zero, 0.0)

    @property
    def settings(self) -> IntegralSettings:
        """Settings; a change keeps K s."""
        return self._settings

    @settings.setter
    def settings(self, settings: IntegralSettings) -> None:
        settings.check_joints(len(self.saturated))
        for s in (self.memory.fast, self.memory.slow):
            s *= self._settings.gain / settings.gain
        self._settings, self._law = settings, settings.law

    @property
    def s(self) -> Array:
        """s~ of eq. (14) that the last torque was computed from, shape (n,), rad/s."""
        return mix(self.memory.fast, self.memory.slow, self._law.mu)

    def reset(self, arm: ArmTerms) -> None:
        """See `IntegralAction`."""
        for array in self.memory:
            array.fill(0.0)
        self.memory.v[:] = arm.v
        self.leak = 0.0
        self.saturated.fill(False)

    def torque(self, arm: ArmTerms, a_last: Array, dt: float) -> Array:
        """See `IntegralAction`."""
        arm.check(len(self.saturated), len(arm.J))
        check_time(dt)
        if a_last.shape != self.saturated.shape:
            raise ValueError(f"a_last must have shape {self.saturated.shape}: {a_last.shape}")
        law, torque = self._law, np.empty_like(a_last)
        leak = step(
            *self.memory,
            law.budget,
            law.gain,
            law.slow_leak_rate,
            law.fast_leak_rate,
            law.mu,
            law.method,
            self.leak,
            arm.M,
            arm.C,
            arm.v,
            a_last,
            float(dt),
            torque,
            self.saturated,
        )
        if math.isnan(leak):
            raise ValueError("dynamics, velocity and acceleration must be finite")
        self.leak = leak
        return torque

    def skip(self, arm: ArmTerms, dt: float) -> None:
        """See `IntegralAction`."""
        check_time(dt)
        arm.check_velocity()
        self.memory.v[:] = arm.v
        advance(self.memory, self._law, self.leak, arm.v, 0.0 * arm.v, float(dt))

    def initialise(self, torque: Array, arm: ArmTerms) -> Array:
        """See `IntegralAction`; it is then forgotten at the slow rate.

        Raises:
            InitialisationError: the torque is not finite, or the arm moves so fast that C + K
                cannot be inverted.
        """
        mu, memory = self._law.mu, self.memory
        K = self._law.gain * np.diagonal(arm.M)
        try:
            s = np.linalg.solve(arm.C + np.diag(K), torque)
        except np.linalg.LinAlgError:
            s = np.full_like(torque, np.nan)
        # A NaN is not of sensible size.
        if not np.abs(K * s).max() <= _AMPLIFIED * np.abs(torque).max():
            raise InitialisationError("the arm moves too fast: C + K cannot be inverted")
        if mu < 1.0:
            memory.slow[:] = (s - mu * memory.fast) / (1.0 - mu)
        else:
            memory.fast[:] = s
        limited = torque if self._law.method == QP else K * s
        memory.widening[:] = np.maximum(np.abs(limited) - self._law.budget, 0.0)
        result = np.empty_like(torque)
        self.leak = evaluate(memory, self._law, arm.M, arm.C, result, self.saturated)
        return result
