# SPDX-License-Identifier: Apache-2.0
"""The QP of a control step, solved by least relaxation where its limits contradict each other.

The torque limits together with the acceleration bounds and the constraints on G a may have no
solution. Then the torque limits are kept, and bounds and constraints are relaxed as little as
possible, in the sense of least squares.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torque_safety_controller.qp.program import (
    AccelerationRange,
    ContactForces,
    LinearConstraints,
    NoSolutionFound,
    QuadraticProgram,
    TaskTerm,
    build_program,
)
from torque_safety_controller.qp.relax import LeastRelaxation, first_to_solve
from torque_safety_controller.qp.solvers import SOLVERS, Status

Array = NDArray[np.float64]

_NEGLIGIBLE = 1e-6
"""Less relaxation than this, rad/s^2, is none."""


class Solution(NamedTuple):
    """Accelerations and forces that serve the tasks best."""

    a: Array
    """Accelerations, shape (n,), rad/s^2."""
    rho: Array
    """Coefficients of the contact forces, shape (r,), N; the motors give M a + h - B rho."""
    relaxation: Array | None
    """By how much bounds were relaxed, shape (n,), rad/s^2; None when nothing was."""
    constraint_relaxation: Array | None
    """By how much constraints were relaxed, shape (k,), in their units; None when nothing was."""
    iterations: int
    """Of the solver."""

    @property
    def exact(self) -> bool:
        """Whether no limit was relaxed."""
        return self.relaxation is None and self.constraint_relaxation is None


class InverseDynamicsQP:
    """Builds the QP of a control step, and solves it, starting from the solution of the last one.

    Args:
        n: number of joints.
        gamma: weight of |x|^2, relative to the largest task weight; keeps the solution unique.
        solver: name of the solver to ask first, one of `SOLVERS`.
    """

    def __init__(self, n: int, gamma: float = 1e-6, solver: str = "daqp") -> None:
        self._n = n
        self._gamma = gamma
        solvers = {name: make() for name, make in SOLVERS.items()}
        # Limits that leave next to no room are DAQP's in any case: ProxQP can hardly solve those.
        self._relaxed_solvers = tuple(solvers.values())
        self._solvers = (solvers.pop(solver), *solvers.values())
        self._relaxation = LeastRelaxation()

    def build(
        self,
        tasks: Sequence[TaskTerm],
        bounds: AccelerationRange,
        M: Array,
        tau_lower: Array,
        tau_upper: Array,
        constraints: LinearConstraints | None = None,
        contacts: ContactForces | None = None,
    ) -> QuadraticProgram:
        """Return the program; see `build_program`."""
        return build_program(
            tasks, bounds, M, tau_lower, tau_upper, constraints, contacts, self._gamma
        )

    def solve(self, program: QuadraticProgram) -> Solution:
        """Return the accelerations and forces that serve the tasks best within the limits.

        Args:
            program: as `build` returned it.

        Raises:
            NoSolutionFound: numbers that are not finite or absurd, or limits that are crossed.
        """
        n = self._n
        status, x, iterations = self._solvers[0].solve(program)
        if status is Status.FAILED:
            status, x, iterations = self._solvers[1].solve(program)
        relaxation = constraint_relaxation = None
        if status is Status.INFEASIBLE:
            x, iterations = self._relaxed(program)
            violations = program.violations(x)
            bounds, rows = violations[:n], violations[len(x) + n :]
            if max(bounds.max(), rows.max(initial=0.0)) >= _NEGLIGIBLE:
                relaxation, constraint_relaxation = bounds, rows
        elif status is not Status.SOLVED:
            raise NoSolutionFound("not finite, absurd, or lower limits above upper ones", program)
        return Solution(x[:n], x[n:], relaxation, constraint_relaxation, iterations)

    def _relaxed(self, program: QuadraticProgram) -> tuple[Array, int]:
        """Return the solution with bounds and constraints relaxed least, and the iterations."""
        relaxed = self._relaxation.relax(program, self._n)
        result = first_to_solve(self._relaxed_solvers, relaxed.program)
        # Where too little room is left for the tasks, what relaxes least keeps the limits, too.
        x = result.x if result.status is Status.SOLVED else relaxed.x
        return x, relaxed.iterations + result.iterations
