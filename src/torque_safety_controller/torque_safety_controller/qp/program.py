# SPDX-License-Identifier: Apache-2.0
"""The quadratic program of a control step: eq. (5) of [Benallegue2021].

    minimise    sum_t w_t |A_t a - b_t|^2 + sum_c w_c |W_c rho - F_c|^2 + gamma (|a|^2 + |rho|^2)
    subject to  a_lower <= a <= a_upper,   lower <= G a <= upper,   0 <= rho <= rho_max,
                tau_min <= M a + h - B rho <= tau_max.

Without contacts it is eq. (33) of [DelPrete2018]. Torques are eliminated by the dynamics.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np
from numba import njit
from numpy.typing import NDArray

from torque_safety_controller.robot_model import RobotModel
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
    """Shape (m, r): what rho >= 0 means as a wrench, or as some components of it."""
    F_des: Array
    """Shape (m,), N and N m: what the environment should exert on the link."""
    weight: float
    first: int
    """Where the r coefficients begin among those of all contacts."""


class AccelerationRange(NamedTuple):
    """Lower and upper bounds of the joint accelerations."""

    lower: Array
    """Shape (n,), rad/s^2; -inf for no bound."""
    upper: Array
    """Shape (n,), rad/s^2, not below `lower`; inf for no bound."""

    @property
    def fault(self) -> str:
        """What is wrong with bounds that are to be finite, in words; empty for nothing."""
        if not (np.isfinite(self.lower).all() and np.isfinite(self.upper).all()):
            return "not finite"
        return "lower above upper" if (self.lower > self.upper).any() else ""


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


class Constraint(Protocol):
    """Anything that limits the accelerations of the arm in its current state."""

    def constraint(
        self, robot: RobotModel, bounds: AccelerationRange, disturbance: Array | None = None
    ) -> LinearConstraints | None:
        """Return the constraints of one step; None for none.

        Args:
            robot: updated to the current state.
            bounds: of the accelerations, which apply besides.
            disturbance: acceleration on top of the commanded one, shape (n,), rad/s^2.
        """


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


class NoSolutionFound(ArmSafetyError, RuntimeError):
    """No solver solved the program, or there is nothing to build one from.

    Attributes:
        program: what was to be solved; None if it could not be built.
    """

    def __init__(self, message: str, program: QuadraticProgram | None = None) -> None:
        super().__init__(message)
        self.program = program


def stack_constraints(parts: Sequence[LinearConstraints | None]) -> LinearConstraints | None:
    """Return all constraints as one, in order; None without any."""
    given = [part for part in parts if part is not None and len(part.G)]
    if len(given) < 2:
        return given[0] if given else None
    return LinearConstraints(*(np.concatenate(each) for each in zip(*given, strict=True)))


def build_program(
    tasks: Sequence[TaskTerm],
    bounds: AccelerationRange,
    M: Array,
    tau_lower: Array,
    tau_upper: Array,
    constraints: LinearConstraints | None = None,
    contacts: ContactForces | None = None,
    gamma: float = 1e-6,
) -> QuadraticProgram:
    """Return the program in x = (a, rho) with C = (M, -B; G, 0).

    Args:
        tasks: at least one.
        bounds: of the accelerations.
        M: mass matrix, shape (n, n).
        tau_lower: lower limits of M a - B rho, bias torque subtracted, shape (n,), N m.
        tau_upper: upper limits of M a - B rho, shape (n,), N m.
        constraints: on the accelerations besides.
        contacts: what the environment can exert.
        gamma: weight of |x|^2, relative to the largest task weight; keeps the solution unique.

    Raises:
        NoSolutionFound: no task with a weight.
        ValueError: constraints or contacts of the wrong shape.
    """
    n, r, k = len(M), 0, 0
    wrench_tasks: Sequence[WrenchTerm] = ()
    if constraints is not None:
        G, row_lower, row_upper = constraints
        k = len(G)
        if G.shape != (len(row_lower), n) or row_lower.shape != row_upper.shape:
            raise ValueError(
                f"constraints on {n} joints with G {G.shape}, lower {row_lower.shape}, "
                f"upper {row_upper.shape}"
            )
    if contacts is not None:
        B, rho_max, wrench_tasks = contacts
        r = len(rho_max)
        if B.shape != (n, r):
            raise ValueError(f"forces on {n} joints with B {B.shape}, rho_max {rho_max.shape}")
    weights = [task.weight for task in tasks] + [task.weight for task in wrench_tasks]
    greatest = max([0.0, *weights])
    if greatest == 0.0:
        raise NoSolutionFound("no task with a weight above 0")
    size = n + r
    # Mostly one task is of the joints: it is written at once.
    joints = next((task for task in tasks if task.A is None), None)
    b, share = (tau_lower, 0.0) if joints is None else (joints.b, joints.weight / greatest)
    a_lower, a_upper = bounds
    program = QuadraticProgram(
        *_plain(r, k, gamma, a_lower, a_upper, M, tau_lower, tau_upper, b, share)
    )
    H, g, C, lower, upper = program
    if r:
        C[:n, n:] = -B
        upper[n:size] = rho_max
    if k:
        C[n:, :n] = G
        lower[size + n :] = row_lower
        upper[size + n :] = row_upper
    for task in tasks:
        if task.A is not None:
            _add_least_squares(H, g, task.A, task.b, task.weight / greatest, 0)
        elif task is not joints:
            H[range(n), range(n)] += task.weight / greatest
            g[:n] -= task.weight / greatest * task.b
    for W, F_des, weight, first in wrench_tasks:
        rows, columns = W.shape
        if F_des.shape != (rows,) or not 0 <= first <= r - columns:
            raise ValueError(
                f"wrench task with W {W.shape} from force {first} of {r} on, F_des {F_des.shape}"
            )
        _add_least_squares(H, g, W, F_des, weight / greatest, n + first)
    return program


# Compiled, because they are called at every step and NumPy takes several times as long.


@njit(cache=True)
def _plain(
    r: int,
    k: int,
    gamma: float,
    a_lower: Array,
    a_upper: Array,
    M: Array,
    tau_lower: Array,
    tau_upper: Array,
    b: Array,
    weight: float,
) -> tuple[Array, Array, Array, Array, Array]:
    """Return H, g, C, lower, upper of a program in x = (a, rho) with C = (M, 0; 0, 0).

    Its cost is ``gamma |x|^2 / 2 + weight |a - b|^2 / 2``.

    Args:
        r: number of rho, with limits 0.
        k: number of rows below M, with limits 0.
        gamma: weight of |x|^2.
        a_lower: limits of a, shape (n,).
        a_upper: shape (n,).
        M: shape (n, n).
        tau_lower: limits of M a, shape (n,).
        tau_upper: shape (n,).
        b: shape (n,).
        weight: of the difference of a and b.
    """
    n = len(a_lower)
    size = n + r
    H, g, C = np.zeros((size, size)), np.zeros(size), np.zeros((n + k, size))
    lower, upper = np.zeros(size + n + k), np.zeros(size + n + k)
    for i in range(size):
        H[i, i] = gamma
    for i in range(n):
        if weight > 0.0:
            H[i, i] += weight
            g[i] = -weight * b[i]
        for j in range(n):
            C[i, j] = M[i, j]
        lower[i], upper[i] = a_lower[i], a_upper[i]
        lower[size + i], upper[size + i] = tau_lower[i], tau_upper[i]
    return H, g, C, lower, upper


@njit(cache=True)
def _add_least_squares(H: Array, g: Array, A: Array, b: Array, weight: float, first: int) -> None:
    """Add ``weight * |A z - b|^2 / 2`` to the cost ``x'Hx / 2 + g'x``, in place.

    z are as many of x as A has columns, from index `first` on.
    """
    m, n = A.shape
    for i in range(n):
        for j in range(i + 1):
            s = 0.0
            for k in range(m):
                s += A[k, i] * A[k, j]
            s *= weight
            H[first + i, first + j] += s
            if i != j:
                H[first + j, first + i] += s
        s = 0.0
        for k in range(m):
            s += A[k, i] * b[k]
        g[first + i] -= weight * s
