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
from numba import njit
from numpy.typing import NDArray

from torque_safety_controller.qp.program import (
    AccelerationRange,
    ContactForces,
    LinearConstraints,
    NoSolutionFound,
    QuadraticProgram,
    TaskTerm,
)
from torque_safety_controller.qp.relax import relaxed_least
from torque_safety_controller.qp.solvers import (
    SOLVERS,
    DaqpSolver,
    ProxqpSolver,
    Solver,
    Status,
    first_to_solve,
)

Array = NDArray[np.float64]

_NO_FORCES = np.zeros(0)

_NEGLIGIBLE = 1e-6
"""Less relaxation than this, rad/s^2, is none."""

_PROXIMAL = (1e-2, 10.0)
"""Of the search for the least relaxation; between 1e-4 and 1e-2 it makes no difference."""


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
        self._relaxing_solvers: tuple[Solver, ...] = (
            *map(DaqpSolver, _PROXIMAL),
            ProxqpSolver(),
        )

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
        """Return the program in x = (a, rho) with C = (M, -B; G, 0).

        Args:
            tasks: at least one.
            bounds: of the accelerations.
            M: mass matrix, shape (n, n).
            tau_lower: lower limits of M a - B rho, bias torque subtracted, shape (n,), N m.
            tau_upper: upper limits of M a - B rho, shape (n,), N m.
            constraints: on the accelerations besides.
            contacts: what the environment can exert.

        Raises:
            NoSolutionFound: no task with a weight.
            ValueError: constraints or contacts of the wrong shape.
        """
        n = self._n
        weights = [task.weight for task in tasks]
        k = r = 0
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
            weights += [task.weight for task in wrench_tasks]
        greatest = max([0.0, *weights])
        if greatest == 0.0:
            raise NoSolutionFound("no task with a weight above 0")
        size = n + r
        H, g, C = np.zeros((size, size)), np.zeros(size), np.zeros((n + k, size))
        lower, upper = np.zeros(size + n + k), np.zeros(size + n + k)
        # Mostly one task is of the joints: it is written at once.
        joints = [task for task in tasks if task.A is None]
        b, share = (joints[0].b, joints[0].weight / greatest) if joints else (tau_lower, 0.0)
        _write(H, g, C, lower, upper, self._gamma, *bounds, M, tau_lower, tau_upper, b, share)
        for task in joints[1:]:
            H[range(n), range(n)] += task.weight / greatest
            g[:n] -= task.weight / greatest * task.b
        for A, b, weight in tasks:
            if A is not None:
                _add_least_squares(H, g, A, b, weight / greatest, 0)
        if constraints is not None:
            C[n:, :n] = G
            lower[size + n :] = row_lower
            upper[size + n :] = row_upper
        if contacts is not None:
            C[:n, n:] = -B
            upper[n:size] = rho_max
            for W, F_des, weight in wrench_tasks:
                if W.shape != (*F_des.shape, r):
                    shapes = f"W {W.shape}, F_des {F_des.shape}"
                    raise ValueError(f"wrench task of {r} forces, {shapes}")
                _add_least_squares(H, g, W, F_des, weight / greatest, n)
        return QuadraticProgram(H, g, C, lower, upper)

    def solve(self, program: QuadraticProgram) -> Solution:
        """Return the accelerations and forces that serve the tasks best within the limits.

        Args:
            program: as `build` returned it.

        Raises:
            NoSolutionFound: numbers that are not finite or absurd, or limits that are crossed.
        """
        n = self._n
        for solver in self._solvers:
            status, x, iterations = solver.solve(program)
            if status is not Status.FAILED:
                break
        relaxation = constraint_relaxation = None
        if status is Status.INFEASIBLE:
            x, iterations = self._relaxed(program)
            violations = program.violations(x)
            bounds, rows = violations[:n], violations[len(x) + n :]
            if max(bounds.max(), rows.max(initial=0.0)) >= _NEGLIGIBLE:
                relaxation, constraint_relaxation = bounds, rows
        elif status is not Status.SOLVED:
            raise NoSolutionFound("not finite, absurd, or lower limits above upper ones", program)
        a, rho = (x, _NO_FORCES) if len(x) == n else (x[:n], x[n:])
        return Solution(a, rho, relaxation, constraint_relaxation, iterations)

    def _relaxed(self, program: QuadraticProgram) -> tuple[Array, int]:
        """Return the solution with bounds and constraints relaxed least, and the iterations."""
        relaxed, least_x, iterations = relaxed_least(program, self._n, self._relaxing_solvers)
        result = first_to_solve(self._relaxed_solvers, relaxed)
        # Where too little room is left for the tasks, what relaxes least keeps the limits, too.
        x = result.x if result.status is Status.SOLVED else least_x
        return x, iterations + result.iterations


# Compiled, because they are called at every step and NumPy takes several times as long.


@njit(cache=True)
def _write(
    H: Array,
    g: Array,
    C: Array,
    lower: Array,
    upper: Array,
    gamma: float,
    a_lower: Array,
    a_upper: Array,
    M: Array,
    tau_lower: Array,
    tau_upper: Array,
    b: Array,
    weight: float,
) -> None:
    """Write limits of a and M a, and the cost ``gamma |x|^2 / 2 + weight |a - b|^2 / 2``.

    Args:
        H: of zeros, as the next ones: of a `QuadraticProgram` in x = (a, rho).
        g: shape (n + r,).
        C: shape (n + k, n + r).
        lower: shape (n + r + n + k,).
        upper: same shape.
        gamma: weight of |x|^2.
        a_lower: limits of a, shape (n,).
        a_upper: shape (n,).
        M: shape (n, n).
        tau_lower: limits of M a, shape (n,).
        tau_upper: shape (n,).
        b: shape (n,).
        weight: of the difference of a and b.
    """
    n, size = len(a_lower), len(g)
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
