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

from torque_safety_controller.integral_feedback.action import ArmTerms
from torque_safety_controller.integral_feedback.settings import IntegralSettings
from torque_safety_controller.nullspace.kernels import FADING_TIME, NullspaceMemory, step
from torque_safety_controller.nullspace.task_action import TaskAction


class NullspaceCompliance(TaskAction):
    """Additional torque that is stiff in a task of m < n rows; a change of settings keeps s.

    An initial torque that the task does not feel fades with `FADING_TIME`.

    Args:
        settings: their number of joints stays.
        m: rows of the task's Jacobian.

    Raises:
        TaskShapeError: `m` leaves n joints no null space.
    """

    memory: NullspaceMemory

    def __init__(self, settings: IntegralSettings, m: int) -> None:
        super().__init__(settings, m, NullspaceMemory, step)

    def skip(self, arm: ArmTerms, dt: float) -> None:
        """See `IntegralAction`."""
        super().skip(arm, dt)
        memory, decay = self.memory, math.exp(-self._law.slow_leak_rate * dt)
        for array in (memory.a, memory.s, memory.integral, memory.root):
            array *= decay
        memory.offset[:] *= math.exp(-dt / FADING_TIME)
