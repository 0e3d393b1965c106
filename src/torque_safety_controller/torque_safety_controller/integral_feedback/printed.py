# SPDX-License-Identifier: Apache-2.0
"""Null-space compliance as [Benallegue2021] prints it, III-D.

    a = s - J^+ integral(J' s)                                                            (16)
    u = C a - M J^+ J' s - M (J^+)' integral(J' s) + u_K                                  (21)
    u_K = (1 - mu) J^T J^+^T K J^+ J a_slow + mu K a_fast                                 (26)
    a_theta,k = exp(-theta dt) a_theta,k-1 + a_k - a_k-1                                  (13)

u_K is limited by (10), or by (11) with a for s. Nothing but a_slow and a_fast leaks: under a
lasting push s, its integral and with them the rest of u grow without limit.
`docs/theory/nullspace.md` says what the law of `NullspaceCompliance` does instead.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torque_safety_controller.anti_windup import project_to_limits, scale_to_limits
from torque_safety_controller.integral_feedback.law import ArmTerms
from torque_safety_controller.integral_feedback.nullspace import TaskLaw
from torque_safety_controller.integral_feedback.task_inverse import dynamically_consistent_inverse

Array = NDArray[np.float64]


class PrintedMemory(NamedTuple):
    """What lasts from one step to the next.

    Attributes:
        s: integral of a_ref - v', shape (n,), rad/s.
        integral: integral(J' s), shape (m,).
        a: of eq. (16), shape (n,), rad/s.
        slow, fast: its leaky integrals of eq. (13), shape (n,), rad/s.
        v: velocity, shape (n,), rad/s.
        J: Jacobian of the task, shape (m, n).
    """

    s: Array
    integral: Array
    a: Array
    slow: Array
    fast: Array
    v: Array
    J: Array


class PrintedCompliance(TaskLaw):
    """Additional torque of (16), (21) and (26), with the torque of the gains limited."""

    MEMORY = PrintedMemory
    memory: PrintedMemory

    @property
    def leak_rates(self) -> dict[str, float]:
        """See `IntegralLaw`."""
        return {"slow": self.settings.slow_leak_rate, "fast": self.settings.fast_leak_rate}

    def torque(self, arm: ArmTerms, a_last: Array, dt: float) -> Array:
        """See `IntegralLaw`."""
        self.check(arm, a_last)
        memory, settings, mu = self.memory, self.settings, self.settings.mu
        M, C, J, J_dot, v = arm
        J_plus, J_plus_dot = dynamically_consistent_inverse(J, J_dot, M, C + C.T)
        s = memory.s + a_last * dt - (v - memory.v)
        integral = memory.integral + (J - memory.J) @ (0.5 * (memory.s + s))
        a = s - J_plus @ integral
        slow = math.exp(-settings.slow_leak_rate * dt) * memory.slow + a - memory.a
        fast = math.exp(-settings.fast_leak_rate * dt) * memory.fast + a - memory.a
        K = settings.gain * np.diagonal(M)
        stiff = J.T @ (J_plus.T @ (K * (J_plus @ (J @ slow))))
        u_K = (1.0 - mu) * stiff + mu * K * fast
        if settings.anti_windup == "scaling":
            limited = scale_to_limits(u_K, settings.budget)
        else:
            limited = project_to_limits(u_K, a, settings.budget)
        torque: Array = C @ a - M @ (J_plus @ (J_dot @ s) + J_plus_dot @ integral) + limited
        if not math.isfinite(torque.sum() + a.sum() + integral.sum()):
            raise ValueError("all numbers must be finite")
        self.memory = PrintedMemory(s, integral, a, slow, fast, v.copy(), J.copy())
        self.saturated = np.abs(u_K) > settings.budget
        return torque

    def initialise(self, torque: Array, arm: ArmTerms) -> Array:
        """See `IntegralLaw`; the slow memory takes what the task feels of it."""
        a, _ = self.felt_by_task(arm, torque)
        zero, v, J = np.zeros_like(a), arm.v.copy(), arm.J.copy()
        self.memory = PrintedMemory(a, np.zeros(len(J)), a, a, zero, v, J)
        return self.torque(arm, zero, 0.0)
