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

from torque_safety_controller.integral_feedback.action import ArmTerms, IntegralAction
from torque_safety_controller.integral_feedback.kernels import (
    Memory,
    evaluate,
    gain_matrix,
    step,
)
from torque_safety_controller.integral_feedback.leaky_integrator import mix
from torque_safety_controller.integral_feedback.settings import QP, IntegralSettings, Law
from viability_bounds_pkg.compiled import bound
from viability_bounds_pkg.exceptions import ArmSafetyError

Array = NDArray[np.float64]

_AMPLIFIED = 10.0  # how much larger than the torque asked for K s may be when initialised


class InitialisationError(ArmSafetyError, ValueError):
    """The integral action cannot be made to give the torque asked for."""


class IntegralFeedback(IntegralAction):
    """Additional torque (C + K) s of one arm; a change of settings keeps K s.

    Args:
        settings: their number of joints stays.

    Attributes:
        leak: rate at which s is forgotten on top of the leak rates to stay passive, 1/s;
            mostly 0.
    """

    memory: Memory

    def __init__(self, settings: IntegralSettings) -> None:
        n = len(settings.budget)
        self.leak = 0.0
        self._law = settings.law
        inputs = np.eye(n), np.zeros((n, n)), np.zeros(n), np.zeros(n)  # M, C, v, a_last
        super().__init__(settings, Memory(*np.zeros((4, n))), inputs)

    def _use(self, law: Law) -> None:
        for s in (self.memory.fast, self.memory.slow):
            s *= self._law.gain / law.gain
        self._law = law
        M, C, _, _ = self._inputs
        results = self._torque, self.saturated
        self._step = bound(step, self.memory, law, *self._inputs, *results, numbers=2)
        self._evaluate = bound(evaluate, self.memory, law, M, C, *results)

    @property
    def s(self) -> Array:
        """s~ of eq. (14) that the last torque was computed from, shape (n,), rad/s."""
        return mix(self.memory.fast, self.memory.slow, self._law.mu)

    def reset(self, arm: ArmTerms) -> None:
        """See `IntegralAction`."""
        super().reset(arm)
        self.leak = 0.0

    def torque(self, arm: ArmTerms, a_last: Array, dt: float) -> Array:
        """See `IntegralAction`."""
        self._take(arm.M, arm.C, arm.v, a_last)
        leak = self._step(self.leak, dt)
        if math.isnan(leak):
            raise ValueError("dynamics, velocity and acceleration must be finite")
        self.leak = leak
        return self._torque.copy()

    def skip(self, arm: ArmTerms, dt: float) -> None:
        """See `IntegralAction`."""
        super().skip(arm, dt)
        self.memory.fast[:] *= math.exp(-(self._law.fast_leak_rate + self.leak) * dt)
        self.memory.slow[:] *= math.exp(-(self._law.slow_leak_rate + self.leak) * dt)

    def initialise(self, torque: Array, arm: ArmTerms) -> Array:
        """See `IntegralAction`; it is then forgotten at the slow rate.

        Raises:
            InitialisationError: the torque is not finite, or the arm moves so fast that C + K
                cannot be inverted.
        """
        mu, memory = self._law.mu, self.memory
        K = gain_matrix(self._law, np.ascontiguousarray(arm.M))
        try:
            s = np.linalg.solve(arm.C + K, torque)
        except np.linalg.LinAlgError:
            s = np.full_like(torque, np.nan)
        # A NaN is not of sensible size.
        if not np.abs(K @ s).max() <= _AMPLIFIED * np.abs(torque).max():
            raise InitialisationError("the arm moves too fast: C + K cannot be inverted")
        if mu < 1.0:
            memory.slow[:] = (s - mu * memory.fast) / (1.0 - mu)
        else:
            memory.fast[:] = s
        limited = torque if self._law.method == QP else K @ s
        memory.widening[:] = np.maximum(np.abs(limited) - self._law.budget, 0.0)
        self._take(arm.M, arm.C, arm.v, arm.v)
        self.leak = self._evaluate()
        return self._torque.copy()
