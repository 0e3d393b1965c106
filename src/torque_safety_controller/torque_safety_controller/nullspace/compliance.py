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

import numpy as np
from numpy.typing import NDArray

from torque_safety_controller.integral_feedback.action import ArmTerms, IntegralAction
from torque_safety_controller.integral_feedback.settings import IntegralSettings, Law
from torque_safety_controller.linalg.generalized_inverse import check_task_shape
from torque_safety_controller.nullspace.kernels import FADING_TIME, NullspaceMemory, step
from viability_bounds_pkg.compiled import bound

Array = NDArray[np.float64]


class NullspaceCompliance(IntegralAction):
    """Additional torque that is stiff in a task of m < n rows; a change of settings keeps s.

    Args:
        settings: their number of joints stays.
        m: rows of the task's Jacobian.

    Raises:
        TaskShapeError: `m` leaves n joints no null space.
    """

    memory: NullspaceMemory

    def __init__(self, settings: IntegralSettings, m: int) -> None:
        n = len(settings.budget)
        check_task_shape(m, n)
        a, s, root, offset, widening, v, velocity, a_ref = np.zeros((8, n))
        J, J_dot, J_last = np.zeros((3, m, n))
        memory = NullspaceMemory(a, s, np.zeros(m), root, offset, widening, v, J_last)
        self._arm = ArmTerms(np.eye(n), np.zeros((n, n)), J, J_dot, velocity)
        super().__init__(settings, memory, (*self._arm, a_ref))

    def _use(self, law: Law) -> None:
        self._law = law
        results = self._torque, self.saturated
        self._step = bound(
            step, self.memory, law, self._arm, self._inputs[-1], *results, numbers=2
        )

    def reset(self, arm: ArmTerms) -> None:
        """See `IntegralAction`."""
        super().reset(arm)
        self.memory.J[:] = arm.J

    def torque(self, arm: ArmTerms, a_last: Array, dt: float) -> Array:
        """See `IntegralAction`."""
        return self._next(arm, a_last, dt, initialise=0.0)

    def initialise(self, torque: Array, arm: ArmTerms) -> Array:
        """See `IntegralAction`.

        The slow memory takes what the task feels of it, and keeps it; the rest fades with
        `FADING_TIME`.
        """
        self._torque[:] = torque
        return self._next(arm, arm.v, 0.0, initialise=1.0)

    def skip(self, arm: ArmTerms, dt: float) -> None:
        """See `IntegralAction`."""
        super().skip(arm, dt)
        memory, decay = self.memory, math.exp(-self._law.slow_leak_rate * dt)
        for array in (memory.a, memory.s, memory.integral, memory.root):
            array *= decay
        memory.offset[:] *= math.exp(-dt / FADING_TIME)
        memory.J[:] = arm.J

    def _next(self, arm: ArmTerms, a_last: Array, dt: float, initialise: float) -> Array:
        self._take(*arm, a_last)
        try:
            usable = self._step(dt, initialise)
        except np.linalg.LinAlgError as error:
            raise ValueError("M must be positive definite") from error
        if not usable:
            raise ValueError("M must be positive definite, and all numbers finite")
        return self._torque.copy()
