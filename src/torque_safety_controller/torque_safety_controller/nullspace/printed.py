# SPDX-License-Identifier: Apache-2.0
"""Null-space compliance as [Benallegue2021] prints it, III-D.

    a = s - J^+ integral(J' s)                                                            (16)
    u = C a - M J^+ J' s - M (J^+)' integral(J' s) + u_K                                  (21)
    u_K = (1 - mu) J^T J^+^T K J^+ J a_slow + mu K a_fast                                 (26)
    a_theta,k = exp(-theta dt) a_theta,k-1 + a_k - a_k-1                                  (13)

u_K is limited by (10), or by (11) with a for s. Nothing but a_slow and a_fast leaks: under a
lasting push s, its integral and with them the rest of u grow without limit.
`docs/departures.md` says what the law of `NullspaceCompliance` does instead.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torque_safety_controller.anti_windup import clip, project, scale_factor
from torque_safety_controller.integral_feedback.law import WIDENING_TIME, ArmTerms
from torque_safety_controller.integral_feedback.settings import IntegralSettings
from torque_safety_controller.nullspace.compliance import TaskLaw
from torque_safety_controller.nullspace.kernels import THRESHOLD, dynamically_consistent_inverse

Array = NDArray[np.float64]


class PrintedMemory(NamedTuple):
    """What lasts from one step to the next; written in place.

    Attributes:
        s: integral of a_ref - v', shape (n,), rad/s.
        integral: integral(J' s), shape (m,).
        a: of eq. (16), shape (n,), rad/s.
        slow, fast: its leaky integrals of eq. (13), shape (n,), rad/s.
        widening: what has been added to the budgets, N m, shape (n,).
        v: velocity, shape (n,), rad/s.
        J: Jacobian of the task, shape (m, n).
    """

    s: Array
    integral: Array
    a: Array
    slow: Array
    fast: Array
    widening: Array
    v: Array
    J: Array


class PrintedCompliance(TaskLaw):
    """Additional torque of (16), (21) and (26), with the torque of the gains limited.

    Args:
        settings: their number of joints stays.
        m: rows of the task's Jacobian.

    Raises:
        TaskShapeError: `m` leaves n joints no null space.
    """

    memory: PrintedMemory

    def __init__(self, settings: IntegralSettings, m: int) -> None:
        super().__init__(settings, m, PrintedMemory)

    def skip(self, arm: ArmTerms, dt: float) -> None:
        """See `IntegralLaw`."""
        super().skip(arm, dt)
        self.memory = self.memory._replace(
            slow=math.exp(-self.settings.slow_leak_rate * dt) * self.memory.slow,
            fast=math.exp(-self.settings.fast_leak_rate * dt) * self.memory.fast,
        )

    def torque(self, arm: ArmTerms, a_last: Array, dt: float) -> Array:
        """See `IntegralLaw`."""
        inverse = self._inverse(arm, a_last)
        memory, settings = self.memory, self.settings
        s = memory.s + a_last * dt - (arm.v - memory.v)
        integral = memory.integral + (arm.J - memory.J) @ (0.5 * (memory.s + s))
        a = s - inverse[0] @ integral
        slow = math.exp(-settings.slow_leak_rate * dt) * memory.slow + a - memory.a
        fast = math.exp(-settings.fast_leak_rate * dt) * memory.fast + a - memory.a
        u_K = self._gain_torque(arm, inverse[0], slow, fast)
        widening = math.exp(-dt / WIDENING_TIME) * memory.widening
        return self._finish(arm, *inverse, s, integral, a, slow, fast, u_K, widening)

    def initialise(self, torque: Array, arm: ArmTerms) -> Array:
        """See `IntegralLaw`; the slow memory takes what the task feels of it."""
        inverse = self._inverse(arm, torque)
        a = self._initial(arm, inverse[0], torque)
        fast, integral = np.zeros_like(a), np.zeros(len(arm.J))
        u_K = self._gain_torque(arm, inverse[0], a, fast)
        widening = np.maximum(np.abs(u_K) - self.settings.budget, 0.0)
        return self._finish(arm, *inverse, a, integral, a, a, fast, u_K, widening)

    def _inverse(self, arm: ArmTerms, vector: Array) -> tuple[Array, Array]:
        """Return J^+ and its time derivative; see `_check`."""
        self._check(arm, vector)
        M, C, J, J_dot, _ = arm
        return dynamically_consistent_inverse(J, J_dot, M, C + C.T, THRESHOLD)

    def _gain_torque(self, arm: ArmTerms, J_plus: Array, slow: Array, fast: Array) -> Array:
        """Return u_K of (26), shape (n,)."""
        K, mu = self.settings.gain * np.diagonal(arm.M), self.settings.mu
        stiff = K * (J_plus @ (arm.J @ slow))
        u_K: Array = (1.0 - mu) * (arm.J.T @ (J_plus.T @ stiff)) + mu * K * fast
        return u_K

    def _finish(
        self,
        arm: ArmTerms,
        J_plus: Array,
        J_plus_dot: Array,
        s: Array,
        integral: Array,
        a: Array,
        slow: Array,
        fast: Array,
        u_K: Array,
        widening: Array,
    ) -> Array:
        """Write the memory; return the torque of (21)."""
        M, C, J, J_dot, v = arm
        limit = self.settings.budget + widening
        if self.settings.anti_windup == "scaling":
            limited = clip(scale_factor(u_K, limit) * u_K, limit)
        else:
            limited = project(u_K, a, limit)
        torque = C @ a - M @ (J_plus @ (J_dot @ s) + J_plus_dot @ integral) + limited
        if not math.isfinite(torque.sum() + a.sum() + integral.sum()):
            raise ValueError("all numbers must be finite")
        self.memory = PrintedMemory(s, integral, a, slow, fast, widening, v.copy(), J.copy())
        self.saturated = np.abs(u_K) > limit
        return torque
