# SPDX-License-Identifier: Apache-2.0
"""Null-space compliance as [Benallegue2021] prints it, III-D, to be compared with.

    a = s - J^+ integral(J' s)                                                            (16)
    u = C a - M J^+ J' s - M (J^+)' integral(J' s) + u_K                                  (21)
    u_K = (1 - mu) J^T J^+^T K J^+ J a_slow + mu K a_fast                                 (26)
    a_theta,k = exp(-theta dt) a_theta,k-1 + a_k - a_k-1                                  (13)

u_K is limited by (10), by (11) with a for s, or not at all. Nothing but a_slow and a_fast leaks:
under a lasting push s, its integral and with them the rest of u grow without limit.
`docs/departures.md` says what the law of `NullspaceCompliance` does instead.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torque_safety_controller.anti_windup import clip, project, scale_factor
from torque_safety_controller.integral_feedback.action import ArmTerms
from torque_safety_controller.integral_feedback.kernels import gain_torque
from torque_safety_controller.integral_feedback.leaky_integrator import leak_factors
from torque_safety_controller.integral_feedback.settings import (
    NONE,
    SCALING,
    WIDENING_TIME,
    Law,
)
from torque_safety_controller.linalg.generalized_inverse import (
    THRESHOLD,
    dynamically_consistent_inverse,
)
from torque_safety_controller.nullspace.kernels import initial_memory, usable
from viability_bounds_pkg.compiled import compiled

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


@compiled
def step(
    memory: PrintedMemory,
    law: Law,
    arm: ArmTerms,
    a_ref: Array,
    torque: Array,
    saturated: NDArray[np.bool_],
    dt: float,
    initialise: float,
) -> bool:
    """Take one step; return whether the arguments were usable. If not, the memory is as before.

    Arguments as of `nullspace.kernels.step`; `torque` receives what the memory holds of it.

    Raises:
        LinAlgError: M is singular.
    """
    M, C, J, J_dot, v = arm
    if not usable(arm, a_ref, torque, initialise):
        return False
    J_plus, J_plus_dot = dynamically_consistent_inverse(J, J_dot, M, C + C.T, THRESHOLD)
    if initialise > 0.0:
        s = initial_memory(law, arm, J_plus, torque)
        integral = np.zeros(len(J))
        a = s
        slow, fast = a, np.zeros_like(a)
    else:
        s = memory.s + a_ref * dt - (v - memory.v)
        integral = memory.integral + (J - memory.J) @ (0.5 * (memory.s + s))
        a = s - J_plus @ integral
        slow_kept, _ = leak_factors(law.slow_leak_rate, dt, True)
        fast_kept, _ = leak_factors(law.fast_leak_rate, dt, True)
        slow = slow_kept * memory.slow + a - memory.a
        fast = fast_kept * memory.fast + a - memory.a
    stiff = gain_torque(law, M, J_plus @ (J @ slow))
    u_K = (1.0 - law.mu) * (J.T @ (J_plus.T @ stiff)) + law.mu * gain_torque(law, M, fast)
    if initialise > 0.0:
        widening = np.maximum(np.abs(u_K) - law.budget, 0.0)
    else:
        widening = math.exp(-dt / WIDENING_TIME) * memory.widening
    limit = law.budget + widening
    if law.method == NONE:
        limited = u_K
    elif law.method == SCALING:
        limited = clip(scale_factor(u_K, limit) * u_K, limit)
    else:
        limited = project(u_K, a, limit)
    result = C @ a - M @ (J_plus @ (J_dot @ s) + J_plus_dot @ integral) + limited
    if not math.isfinite(result.sum() + a.sum() + integral.sum()):
        return False
    torque[:] = result
    saturated[:] = (np.abs(u_K) > limit) & (law.method != NONE)
    memory.s[:] = s
    memory.integral[:] = integral
    memory.a[:] = a
    memory.slow[:] = slow
    memory.fast[:] = fast
    memory.widening[:] = widening
    memory.v[:] = v
    memory.J[:] = J
    return True
