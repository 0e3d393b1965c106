# SPDX-License-Identifier: Apache-2.0
"""What the quadratic program of a control step is made of: eq. (5) of [Benallegue2021].

    minimise    sum_t w_t |A_t a - b_t|^2 + sum_c w_c |W_c rho - F_c|^2 + gamma (|a|^2 + |rho|^2)
    subject to  a_lower <= a <= a_upper,   lower <= G a <= upper,   0 <= rho <= rho_max,
                tau_min <= M a + h - B rho <= tau_max.

Without contacts it is eq. (33) of [DelPrete2018]. Torques are eliminated by the dynamics.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from viability_bounds_pkg.exceptions import ArmSafetyError

Array = NDArray[np.float64]


class TaskTerm(NamedTuple):
    """The term ``weight * |A a - b|^2`` of the cost: eq. (5) and (9) of [Benallegue2021]."""

    A: Array | None
    """Shape (m, n); None for the identity, which spares the product."""
    b: Array
    """Shape (m,)."""
    weight: float

    def mixed(self, a: Array, share: float) -> TaskTerm:
        """Return the term that wants `share` of its own and the rest of an acceleration.

        Args:
            a: shape (n,), rad/s^2.
            share: from 0 to 1.
        """
        other = a if self.A is None else self.A @ a
        return self._replace(b=share * self.b + (1.0 - share) * other)


class WrenchTerm(NamedTuple):
    """The term ``weight * |W rho - F_des|^2`` of the cost: [Benallegue2021], III-E (a)."""

    W: Array
    """Shape (m, r): what rho >= 0 means as a wrench, or as some components of one."""
    F_des: Array
    """Shape (m,), N and N m: what the environment should exert on the link."""
    weight: float


class AccelerationRange(NamedTuple):
    """Lower and upper bounds of the joint accelerations."""

    lower: Array
    """Shape (n,), rad/s^2; -inf for no bound."""
    upper: Array
    """Shape (n,), rad/s^2, not below `lower`; inf for no bound."""

    @property
    def fault(self) -> str:
        """What is wrong with bounds that are to be finite, in words; empty for nothing."""
        lower, upper = self.lower.tolist(), self.upper.tolist()  # faster than arrays of few
        if not all(map(math.isfinite, lower + upper)):
            return "not finite"
        return "lower above upper" if any(map(operator.gt, lower, upper)) else ""


class LinearConstraints(NamedTuple):
    """The constraints ``lower <= G a <= upper`` on the joint accelerations a.

    Equal limits make an equality. Where the torque limits leave no solution, these constraints
    and the acceleration bounds are relaxed together, by the least sum of squares. Scaling a row
    of G and its limits by s multiplies the cost of relaxing it by s^2, up to a length of 1e4 of
    the row.
    """

    G: Array
    """Shape (k, n)."""
    lower: Array
    """Shape (k,); -inf for no limit."""
    upper: Array
    """Shape (k,), not below `lower`; inf for no limit."""


class ContactForces(NamedTuple):
    """Forces of the environment on the arm, W rho with rho >= 0."""

    B: Array
    """What rho adds to the joint torques, the sum of J' W: shape (n, r)."""
    rho_max: Array
    """Shape (r,), N: inf, or 0 for contacts that are open."""
    tasks: Sequence[WrenchTerm] = ()
    """What the forces should be."""


class QuadraticProgram(NamedTuple):
    """``min x'Hx/2 + g'x  subject to  lower <= (x, C x) <= upper``; equal limits are equalities.

    Solvers do not change its arrays.
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


class NoSolutionFound(ArmSafetyError, RuntimeError):
    """No solver solved the program, or there is nothing to build one from.

    Attributes:
        program: what was to be solved; None if it could not be built.
    """

    def __init__(self, message: str, program: QuadraticProgram | None = None) -> None:
        super().__init__(message)
        self.program = program
