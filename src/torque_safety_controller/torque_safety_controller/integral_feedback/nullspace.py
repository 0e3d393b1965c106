# SPDX-License-Identifier: Apache-2.0
"""Stiff in a task, free in its null space: [Benallegue2021], III-D.

The acceleration error ``s' = a_ref - v'`` is integrated into

    a = s - J^+ integral(J' s),   J a = integral(J s') = integral(e_T''),       (16), (25)

and the torque added to that of the reference is

    C a - M J^+ J' s - M (J^+)' integral(J' s)
        + (1 - mu) P^T K P a + mu K a_fast,   P = J^+ J,   K = lambda diag(M).  (21), (26)

The task's error is integrated, and its integral dies away; the null space is held by a memory of
some 10 ms only. The torque is linear in the memory (a, x), where x = a - a_fast is what the fast
memory has forgotten, and the stored energy is quadratic. `docs/theory/nullspace.md` derives
it, says where it leaves the paper, and proves that nothing in it grows for ever.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torque_safety_controller.integral_feedback.law import ArmTerms, IntegralLaw
from torque_safety_controller.integral_feedback.leaky_integrator import leak_factors
from torque_safety_controller.integral_feedback.nullspace_step import (
    THRESHOLD,
    advance,
    dynamically_consistent_inverse,
)
from torque_safety_controller.integral_feedback.settings import IntegralSettings
from viability_bounds_pkg.exceptions import ArmSafetyError

Array = NDArray[np.float64]

_SINGULAR = 1e-12  # relative size of singular values that are rounding
_AT_LIMIT = 1.0 - 1e-9


class TaskShapeError(ArmSafetyError, ValueError):
    """A task that leaves an arm no null space."""


class Memory(NamedTuple):
    """What lasts from one step to the next.

    Attributes:
        a: the error that dies away, eq. (16), shape (n,), rad/s.
        s: its part in the null space, (1 - J^+ J) a, shape (n,), rad/s.
        integral: integral(J' s), which is - J a, shape (m,).
        root: ``sqrt(diag M) x``, shape (n,): its square is the fast memory's energy whatever M
            does.
        v: velocity, shape (n,), rad/s.
        J: Jacobian of the task, shape (m, n).
    """

    a: Array
    s: Array
    integral: Array
    root: Array
    v: Array
    J: Array


class TaskLaw(IntegralLaw):
    """Integral action that is stiff in a task of m < n rows.

    Args:
        settings: their number of joints stays.
        m: rows of the task's Jacobian.
        memory: type of the named tuple; its `integral` gets m numbers, `J` shape (m, n), all
            others n numbers.

    Raises:
        TaskShapeError: `m` leaves n joints no null space.
    """

    def __init__(self, settings: IntegralSettings, m: int, memory: Any) -> None:
        n = len(settings.budget)
        if not 0 < m < n:
            raise TaskShapeError(
                f"a task of {m} rows for {n} joints; null-space compliance needs 1 to {n - 1} rows"
            )
        shapes = {"integral": (m,), "J": (m, n)}
        super().__init__(settings, memory(*(np.zeros(shapes.get(k, n)) for k in memory._fields)))

    def reset(self, arm: ArmTerms) -> None:
        """See `IntegralLaw`."""
        super().reset(arm)
        self.memory.J[:] = arm.J

    def skip(self, arm: ArmTerms, dt: float) -> None:
        """See `IntegralLaw`."""
        super().skip(arm, dt)
        self.memory = self.memory._replace(J=arm.J.copy())

    def check(self, arm: ArmTerms, vector: Array) -> None:
        """Raise `ValueError` unless all is finite, and M can be a mass matrix."""
        M, C, J, J_dot, v = arm
        total = M.sum() + C.sum() + J.sum() + J_dot.sum() + v.sum() + vector.sum()
        if not (math.isfinite(total) and (np.diagonal(M) > 0.0).all()):
            raise ValueError("M must be positive definite, and all numbers finite")

    def felt_by_task(self, arm: ArmTerms, torque: Array) -> tuple[Array, Array]:
        """Return the a whose slow memory gives what the task feels of `torque`, and J^+.

        The task feels the force F = J^+^T torque. Where J a = y the slow torque is
        J^T ((1 - mu) J^+^T K J^+ y), which is J^T F for this y.

        Raises:
            ValueError: see `check`.
        """
        self.check(arm, torque)
        M, C, J, J_dot, _ = arm
        J_plus, _ = dynamically_consistent_inverse(J, J_dot, M, C + C.T, THRESHOLD)
        K = self.settings.gain * np.diagonal(M)
        B = (1.0 - self.settings.mu) * (J_plus.T * K) @ J_plus
        return J_plus @ (np.linalg.pinv(B, _SINGULAR) @ (J_plus.T @ torque)), J_plus


class NullspaceCompliance(TaskLaw):
    """Additional torque that is stiff in a task of m < n rows.

    Args:
        settings: their number of joints stays.
        m: rows of the task's Jacobian.

    Raises:
        TaskShapeError: `m` leaves n joints no null space.
    """

    memory: Memory

    def __init__(self, settings: IntegralSettings, m: int) -> None:
        super().__init__(settings, m, Memory)
        self._none = np.zeros_like(self.saturated)

    @property
    def leak_rates(self) -> dict[str, float]:
        """See `IntegralLaw`."""
        return dict.fromkeys(("a", "s", "integral", "root"), self.settings.slow_leak_rate)

    def torque(self, arm: ArmTerms, a_last: Array, dt: float) -> Array:
        """See `IntegralLaw`."""
        settings = self.settings
        slow, fast = settings.slow_leak_rate, settings.fast_leak_rate
        factors = (*leak_factors(slow, dt, False), *leak_factors(fast, dt, False))
        numbers = (settings.gain, settings.mu, fast_weight(settings))
        a, s, integral, root, torque, limited, usable = advance(
            tuple(self.memory), tuple(arm), a_last, dt, settings.budget, numbers, factors
        )
        if not usable:
            raise ValueError("M must be positive definite, and all numbers finite")
        self.memory = Memory(a, s, integral, root, arm.v.copy(), arm.J.copy())
        at_limit = np.abs(torque) >= _AT_LIMIT * settings.budget if limited else self._none
        self.saturated = at_limit
        return torque

    def initialise(self, torque: Array, arm: ArmTerms) -> Array:
        """See `IntegralLaw`; the slow memory takes what the task feels of it."""
        a, J_plus = self.felt_by_task(arm, torque)
        zero, integral = np.zeros_like(a), -(arm.J @ a)
        forgets = self.settings.fast_leak_rate > self.settings.slow_leak_rate
        root = np.sqrt(np.diagonal(arm.M)) * a if forgets else zero
        null = a + J_plus @ integral
        self.memory = Memory(a, null, integral, root, arm.v.copy(), arm.J.copy())
        return self.torque(arm, zero, 0.0)


def fast_weight(settings: IntegralSettings) -> float:
    """Return the weight w of the fast memory in the energy (a'M a + w x' diag(M) x) / 2."""
    if settings.fast_leak_rate > settings.slow_leak_rate:
        return settings.mu * settings.gain / (settings.fast_leak_rate - settings.slow_leak_rate)
    return 0.0
