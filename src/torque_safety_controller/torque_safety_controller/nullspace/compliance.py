# SPDX-License-Identifier: Apache-2.0
"""Stiff in a task, free in its null space: [Benallegue2021], III-D.

The acceleration error ``s' = a_ref - v'`` is integrated into

    a = s - J^+ integral(J' s),   J a = integral(J s') = integral(e_T''),       (16), (25)

and the torque added to that of the reference is

    C a - M J^+ J' s - M (J^+)' integral(J' s)
        + (1 - mu) P^T K P a + mu K a_fast,   P = J^+ J,   K = lambda diag(M).  (21), (26)

The task's error is integrated, and its integral dies away; the null space is held by a memory of
some 10 ms only. `docs/nullspace_compliance.md` says where this leaves the paper, and proves that
nothing in it grows for ever.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from torque_safety_controller.integral_feedback.action import ArmTerms, IntegralAction
from torque_safety_controller.integral_feedback.settings import IntegralSettings, Law
from torque_safety_controller.nullspace.kernels import FADING_TIME, NullspaceMemory, step
from torque_safety_controller.nullspace.printed import PrintedMemory
from torque_safety_controller.nullspace.printed import step as printed_step
from viability_bounds_pkg.compiled import bound
from viability_bounds_pkg.exceptions import ArmSafetyError

Array = NDArray[np.float64]


class TaskShapeError(ArmSafetyError, ValueError):
    """A task that leaves an arm no null space."""


class NullspaceCompliance(IntegralAction):
    """Additional torque that is stiff in a task of m < n rows; a change of settings keeps s.

    An initial torque that the task does not feel fades with `FADING_TIME`.

    Args:
        settings: their number of joints stays.
        m: rows of the task's Jacobian.

    Raises:
        TaskShapeError: `m` leaves n joints no null space.
    """

    _MEMORY: ClassVar[Any] = NullspaceMemory
    """`integral` has m numbers, `J` has shape (m, n), all others have n numbers."""
    _KERNEL: ClassVar[Callable[..., bool]] = step

    def __init__(self, settings: IntegralSettings, m: int) -> None:
        n = len(settings.budget)
        if not 0 < m < n:
            raise TaskShapeError(
                f"a task of {m} rows for {n} joints; null-space compliance needs 1 to {n - 1} rows"
            )
        shapes = {"integral": (m,), "J": (m, n)}
        fields = (np.zeros(shapes.get(name, (n,))) for name in self._MEMORY._fields)
        J, J_dot = np.zeros((2, m, n))
        self._arm = ArmTerms(np.eye(n), np.zeros((n, n)), J, J_dot, np.zeros(n))
        super().__init__(settings, self._MEMORY(*fields), (*self._arm, np.zeros(n)))

    def _use(self, law: Law) -> None:
        self._law = law
        results = self._torque, self.saturated
        self._step = bound(
            self._KERNEL, self.memory, law, self._arm, self._inputs[-1], *results, numbers=2
        )

    def reset(self, arm: ArmTerms) -> None:
        """See `IntegralAction`."""
        super().reset(arm)
        self.memory.J[:] = arm.J

    def torque(self, arm: ArmTerms, a_last: Array, dt: float) -> Array:
        """See `IntegralAction`."""
        return self._next(arm, a_last, dt, initialise=0.0)

    def initialise(self, torque: Array, arm: ArmTerms) -> Array:
        """See `IntegralAction`; the slow memory takes what the task feels of it."""
        self._torque[:] = torque
        return self._next(arm, arm.v, 0.0, initialise=1.0)

    def skip(self, arm: ArmTerms, dt: float) -> None:
        """See `IntegralAction`."""
        super().skip(arm, dt)
        self.memory.J[:] = arm.J
        self._leak(dt)

    def _leak(self, dt: float) -> None:
        """Let the memory leak for a time, s."""
        memory, decay = self.memory, math.exp(-self._law.slow_leak_rate * dt)
        for array in (memory.a, memory.s, memory.integral, memory.root):
            array *= decay
        memory.offset[:] *= math.exp(-dt / FADING_TIME)

    def _next(self, arm: ArmTerms, a_last: Array, dt: float, initialise: float) -> Array:
        self._take(*arm, a_last)
        try:
            usable = self._step(dt, initialise)
        except np.linalg.LinAlgError as error:
            raise ValueError("M must be positive definite") from error
        if not usable:
            raise ValueError("M must be positive definite, and all numbers finite")
        return self._torque.copy()


class PrintedCompliance(NullspaceCompliance):
    """The same by (16), (21) and (26) as printed: see `printed`."""

    _MEMORY = PrintedMemory
    _KERNEL = printed_step

    def _leak(self, dt: float) -> None:
        self.memory.slow[:] *= math.exp(-self._law.slow_leak_rate * dt)
        self.memory.fast[:] *= math.exp(-self._law.fast_leak_rate * dt)
