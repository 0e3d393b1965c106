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

import numpy as np
from numpy.typing import NDArray

from torque_safety_controller.integral_feedback.action import ArmTerms, check_time
from torque_safety_controller.integral_feedback.settings import IntegralSettings
from torque_safety_controller.linalg.generalized_inverse import check_task_shape
from torque_safety_controller.nullspace.kernels import (
    FAILED,
    NEAR_SINGULAR,
    NullspaceMemory,
    skip,
    step,
)

Array = NDArray[np.float64]


class NullspaceCompliance:
    """Additional torque that is stiff in a task of m < n rows, an `IntegralAction`.

    Args:
        settings: their number of joints stays.
        m: rows of the task's Jacobian.

    Attributes:
        settings: may be replaced between steps.
        memory: errors and budgets; the torque continues from it.
        near_singular: whether J was so near to a singularity in the last step that some
            direction of the task was not fully served.
        saturated: which joints were at their budgets in the last step, shape (n,); overwritten by
            the next.

    Raises:
        TaskShapeError: `m` leaves n joints no null space.
    """

    def __init__(self, settings: IntegralSettings, m: int) -> None:
        n = len(settings.budget)
        check_task_shape(m, n)
        self._shape = m, n
        a, s, root, offset, widening, v = np.zeros((6, n))
        self.memory = NullspaceMemory(
            a, s, np.zeros(m), root, offset, widening, v, np.zeros((m, n))
        )
        self.near_singular = False
        self.saturated = np.zeros(n, dtype=bool)
        self.settings = settings
        # The first call compiles; let it be this one and not one in a control loop.
        zero, square, rows = np.zeros(n), np.zeros((n, n)), np.eye(m, n)
        arm = ArmTerms(np.eye(n), square, rows, 0.0 * rows, zero)
        self.torque(arm, zero, 0.0)
        self.skip(arm, 0.0)

    @property
    def settings(self) -> IntegralSettings:
        """Settings; a change keeps the memory."""
        return self._settings

    @settings.setter
    def settings(self, settings: IntegralSettings) -> None:
        settings.check_joints(self._shape[1])
        self._settings, self._law = settings, settings.law

    def reset(self, arm: ArmTerms) -> None:
        """See `IntegralAction`."""
        for array in self.memory:
            array.fill(0.0)
        self.memory.v[:] = arm.v
        self.memory.J[:] = arm.J
        self.near_singular = False
        self.saturated.fill(False)

    def torque(self, arm: ArmTerms, a_last: Array, dt: float) -> Array:
        """See `IntegralAction`."""
        check_time(dt)
        return self._step(arm, a_last, dt, False, np.empty_like(a_last))

    def initialise(self, torque: Array, arm: ArmTerms) -> Array:
        """See `IntegralAction`.

        The slow memory takes what the task feels of it, and keeps it; the rest fades with
        `FADING_TIME`.
        """
        return self._step(arm, arm.v, 0.0, True, torque.copy())

    def skip(self, arm: ArmTerms, dt: float) -> None:
        """See `IntegralAction`."""
        check_time(dt)
        arm.check_velocity()
        skip(self.memory, self._law, arm.v, arm.J, float(dt))

    def _step(
        self, arm: ArmTerms, a_last: Array, dt: float, initialise: bool, torque: Array
    ) -> Array:
        m, n = self._shape
        arm.check(n, m)
        if a_last.shape != (n,) or torque.shape != (n,):
            raise ValueError(f"for {n} joints: vectors {a_last.shape}, {torque.shape}")
        try:
            outcome = step(
                *self.memory,
                *self._law,
                *arm,
                a_last,
                float(dt),
                initialise,
                torque,
                self.saturated,
            )
        except np.linalg.LinAlgError as error:
            raise ValueError("M must be positive definite") from error
        if outcome == FAILED:
            raise ValueError("M must be positive definite, and all numbers finite")
        self.near_singular = outcome == NEAR_SINGULAR
        return torque
