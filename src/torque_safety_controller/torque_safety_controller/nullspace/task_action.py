# SPDX-License-Identifier: Apache-2.0
"""What integral actions with a task have in common: a memory, and a compiled step."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torque_safety_controller.integral_feedback.action import ArmTerms, IntegralAction
from torque_safety_controller.integral_feedback.settings import IntegralSettings, Law
from torque_safety_controller.linalg.generalized_inverse import check_task_shape
from viability_bounds_pkg.compiled import bound

Array = NDArray[np.float64]


class TaskAction(IntegralAction):
    """Additional torque for a task of m < n rows.

    Args:
        settings: their number of joints stays.
        m: rows of the task's Jacobian.
        memory: named tuple; `integral` has m numbers, `J` has shape (m, n), the others have n.
        step: compiled, with the arguments of `nullspace.kernels.step`.

    Raises:
        TaskShapeError: `m` leaves n joints no null space.
    """

    def __init__(
        self, settings: IntegralSettings, m: int, memory: Any, step: Callable[..., bool]
    ) -> None:
        n = len(settings.budget)
        check_task_shape(m, n)
        shapes = {"integral": (m,), "J": (m, n)}
        fields = (np.zeros(shapes.get(name, (n,))) for name in memory._fields)
        J, J_dot = np.zeros((2, m, n))
        self._arm = ArmTerms(np.eye(n), np.zeros((n, n)), J, J_dot, np.zeros(n))
        self._kernel = step
        super().__init__(settings, memory(*fields), (*self._arm, np.zeros(n)))

    def _use(self, law: Law) -> None:
        self._law = law
        results = self._torque, self.saturated
        self._step = bound(
            self._kernel, self.memory, law, self._arm, self._inputs[-1], *results, numbers=2
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

    def _next(self, arm: ArmTerms, a_last: Array, dt: float, initialise: float) -> Array:
        self._take(*arm, a_last)
        try:
            usable = self._step(dt, initialise)
        except np.linalg.LinAlgError as error:
            raise ValueError("M must be positive definite") from error
        if not usable:
            raise ValueError("M must be positive definite, and all numbers finite")
        return self._torque.copy()
