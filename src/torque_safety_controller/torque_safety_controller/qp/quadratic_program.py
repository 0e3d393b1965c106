# SPDX-License-Identifier: Apache-2.0
"""Quadratic programs, what solves them, and what comes out."""

from __future__ import annotations

from enum import Enum
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from viability_bounds_pkg.exceptions import ArmSafetyError

Array = NDArray[np.float64]


class QuadraticProgram(NamedTuple):
    """``min x'Hx/2 + g'x  subject to  lower <= (x, C x) <= upper``; equal limits are equalities.

    The arrays are not to be changed: solvers keep references to them.
    """

    H: Array
    """Shape (p, p), symmetric, positive definite."""
    g: Array
    """Shape (p,)."""
    C: Array
    """Shape (m, p)."""
    lower: Array
    """Limits of x, then of C x, shape (p + m,); -inf for none."""
    upper: Array
    """Shape (p + m,), not below `lower`; inf for none."""

    def cost(self, x: Array) -> float:
        """Return the cost at x, shape (p,)."""
        return float(0.5 * x @ self.H @ x + self.g @ x)

    def violations(self, x: Array) -> Array:
        """Return by how much x, shape (p,), violates each limit, shape (p + m,)."""
        value = np.concatenate([x, self.C @ x])
        violations: Array = np.maximum(np.maximum(self.lower - value, value - self.upper), 0.0)
        return violations


class Status(Enum):
    """How an attempt to solve a program ended."""

    SOLVED = "solved"
    INFEASIBLE = "no point is within all limits"
    FAILED = "not finite, limits crossed, or not solved to the tolerance"


class SolverResult(NamedTuple):
    """What a solver returned."""

    status: Status
    x: Array
    """Shape (p,), within its own limits exactly; means nothing unless solved."""
    iterations: int


class Solver(Protocol):
    """Anything that solves quadratic programs; their sizes may change from call to call."""

    def solve(self, program: QuadraticProgram) -> SolverResult:
        """Return the minimum, or why there is none. Never raises for what the numbers are."""


class NoSolutionFound(ArmSafetyError, RuntimeError):
    """No solver solved the program, or there is nothing to build one from.

    Attributes:
        program: what was to be solved; None if it could not be built.
    """

    def __init__(self, message: str, program: QuadraticProgram | None = None) -> None:
        super().__init__(message)
        self.program = program
