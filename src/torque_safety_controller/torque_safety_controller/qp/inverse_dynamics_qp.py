# SPDX-License-Identifier: Apache-2.0
"""The QP for joint accelerations and contact forces: eq. (5) of [Benallegue2021].

    minimise    sum_t w_t |A_t a - b_t|^2 + sum_c w_c |W_c rho - F_c|^2 + gamma (|a|^2 + |rho|^2)
    subject to  a_lower <= a <= a_upper,   lower <= G a <= upper,   0 <= rho <= rho_max,
                tau_min <= M a + h - B rho <= tau_max.

Without contacts it is eq. (33) of [DelPrete2018]. Torques are eliminated by the dynamics. The
torque limits alone always have a solution, without force, as M is regular; together with the
acceleration bounds and the constraints on G a they may not. Then the torque limits are kept, and
bounds and constraints are relaxed as little as possible, in the sense of least squares.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torque_safety_controller.qp.constraints import AccelerationRange, LinearConstraints
from torque_safety_controller.qp.daqp_solver import DaqpSolver
from torque_safety_controller.qp.kernels import (
    add_identity,
    add_least_squares,
    write_plain,
)
from torque_safety_controller.qp.proxqp_solver import ProxqpSolver
from torque_safety_controller.qp.quadratic_program import (
    NoSolutionFound,
    QuadraticProgram,
    Solver,
    SolverResult,
    Status,
)
from torque_safety_controller.qp.terms import TaskTerm, WrenchTerm

Array = NDArray[np.float64]

SOLVERS: dict[str, Callable[[], Solver]] = {"daqp": DaqpSolver, "proxqp": ProxqpSolver}
"""By name; a solver that fails for numerical reasons is followed by the next one."""

_PROXIMAL = (1e-2, 10.0)
"""Of the search for the least relaxation; between 1e-4 and 1e-2 it makes no difference."""
# Room that is left to the tasks beyond the least relaxation, relative to it where it is above 1,
# and to the length of a row where that is.
_ROOM = 1e-8
_LONGEST = 1e4
"""Constraints with longer rows are scaled to this length when limits must be relaxed."""
_NEGLIGIBLE = 1e-6
"""Less relaxation than this, rad/s^2, is none."""


class ContactForces(NamedTuple):
    """Forces of the environment on the arm, W rho with rho >= 0."""

    B: Array
    """What rho adds to the joint torques, the sum of J' W: shape (n, r)."""
    rho_max: Array
    """Shape (r,), N: inf, or 0 for contacts that are open."""
    tasks: Sequence[WrenchTerm] = ()
    """What the forces should be."""


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


class InverseDynamicsQP:
    """Builds the QP of a control step, and solves it.

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
            *(DaqpSolver(weight) for weight in _PROXIMAL),
            ProxqpSolver(),
        )
        self._no_forces = np.zeros(0)

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
            constraints: on the accelerations besides; their number may change.
            contacts: what the environment can exert; the number of forces may change.

        Raises:
            NoSolutionFound: no task with a weight.
            ValueError: constraints or contacts of the wrong shape.
        """
        n = self._n
        scale = 1.0 / _greatest_weight(tasks, () if contacts is None else contacts.tasks)
        r = k = 0
        if contacts is not None:
            contacts = self._checked_forces(contacts)
            r = len(contacts.rho_max)
        if constraints is not None:
            constraints = self._checked(constraints)
            k = len(constraints.G)
        size = n + r
        H, g, C = np.empty((size, size)), np.empty(size), np.empty((n + k, size))
        lower, upper = np.empty(size + n + k), np.empty(size + n + k)
        write_plain(H, g, C, lower, upper, self._gamma, *bounds, M, tau_lower, tau_upper)
        if contacts is not None:
            C[:n, n:] = -contacts.B
            upper[n:size] = contacts.rho_max
        if constraints is not None:
            C[n:, :n] = constraints.G
            lower[size + n :] = constraints.lower
            upper[size + n :] = constraints.upper
        for A, b, weight in tasks:
            if A is None:
                add_identity(H, g, b, weight * scale)
            else:
                add_least_squares(H, g, A, b, weight * scale, 0)
        if contacts is not None:
            for W, F_des, weight, first in contacts.tasks:
                add_least_squares(H, g, W, F_des, weight * scale, n + first)
        return QuadraticProgram(H, g, C, lower, upper)

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
            x, relaxed, iterations = self._relax(program)
            if relaxed is not None:
                relaxation, constraint_relaxation = relaxed[:n], relaxed[n:]
        elif status is not Status.SOLVED:
            raise NoSolutionFound("not finite, absurd, or lower limits above upper ones", program)
        a, rho = (x[:n], x[n:]) if len(x) > n else (x, self._no_forces)
        return Solution(a, rho, relaxation, constraint_relaxation, iterations)

    def _checked(self, constraints: LinearConstraints) -> LinearConstraints:
        """Return `constraints` in the one layout that the kernels are compiled for."""
        G, lower, upper = (np.ascontiguousarray(each, dtype=float) for each in constraints)
        if G.shape != (len(lower), self._n) or lower.shape != upper.shape or lower.ndim != 1:
            raise ValueError(
                f"constraints on {self._n} joints with G {G.shape}, lower {lower.shape}, "
                f"upper {upper.shape}"
            )
        return LinearConstraints(G, lower, upper)

    def _checked_forces(self, contacts: ContactForces) -> ContactForces:
        B = np.ascontiguousarray(contacts.B, dtype=float)
        rho_max = np.ascontiguousarray(contacts.rho_max, dtype=float)
        if rho_max.ndim != 1 or B.shape != (self._n, len(rho_max)):
            raise ValueError(
                f"forces on {self._n} joints with B {B.shape}, rho_max {rho_max.shape}"
            )
        for W, F_des, _, first in contacts.tasks:
            m, r = W.shape
            if F_des.shape != (m,) or not 0 <= first <= len(rho_max) - r:
                raise ValueError(
                    f"wrench task with W {W.shape} from force {first} of {len(rho_max)} on, "
                    f"F_des {F_des.shape}"
                )
        return ContactForces(B, rho_max, contacts.tasks)

    def _relax(self, program: QuadraticProgram) -> tuple[Array, Array | None, int]:
        """Solve with bounds and constraints moved by the least that leaves a solution.

        First, in the variables (x, e), with S x what may be relaxed, the bounded a and G a:

            minimise |e|^2   subject to   S x - e, rho and the torques in limits;

        then the program itself, with the limits moved by e. Returns its solution; by how much it
        violates the limits of S x, shape (n + k,), None for as good as nothing; and iterations.

        The first is solved for z = L' a, with M = L L': then the rows are no worse conditioned
        than L, whose condition number is the square root of that of M.
        """
        n, size = self._n, len(program.g)
        try:
            from_z = np.linalg.inv(np.linalg.cholesky(program.C[:n, :n])).T
        except np.linalg.LinAlgError as error:
            message = "the mass matrix is not positive definite"
            raise NoSolutionFound(message, program) from error
        relaxable = np.r_[:n, size + n : len(program.lower)]  # where the limits of S x are
        soft = len(relaxable)
        # Beyond this length a row would make the problem too ill-conditioned.
        length = np.maximum(np.linalg.norm(program.C[n:], axis=1) / _LONGEST, 1.0)
        C, lower, upper = program.C.copy(), program.lower.copy(), program.upper.copy()
        C[n:] /= length[:, None]
        lower[size + n :] /= length
        upper[size + n :] /= length
        constraints = np.zeros((n + soft, size + soft))
        constraints[:n, :size] = C[:n]
        constraints[n : 2 * n, :n] = np.eye(n)
        constraints[2 * n :, :size] = C[n:]
        constraints[n:, size:] = -np.eye(soft)
        constraints[:, :n] = constraints[:, :n] @ from_z
        free = np.full(soft, np.inf)
        least = _first_to_solve(
            self._relaxing_solvers,
            QuadraticProgram(
                np.diag(np.concatenate([np.zeros(size), np.ones(soft)])),
                np.zeros(size + soft),
                constraints,
                np.concatenate(
                    [-free[:n], lower[n:size], -free, lower[size : size + n], lower[relaxable]]
                ),
                np.concatenate(
                    [free[:n], upper[n:size], free, upper[size : size + n], upper[relaxable]]
                ),
            ),
        )
        if least.status is not Status.SOLVED:
            raise NoSolutionFound("no accelerations within the torque limits were found", program)
        e = least.x[size:]
        room = _ROOM * max(1.0, float(np.abs(e).max()))
        lower[relaxable] += np.minimum(e, 0.0) - room
        upper[relaxable] += np.maximum(e, 0.0) + room
        result = _first_to_solve(
            self._relaxed_solvers, program._replace(C=C, lower=lower, upper=upper)
        )
        # Where too little room is left for the tasks, what was found first keeps the limits, too.
        x = result.x
        if result.status is not Status.SOLVED:
            x = np.concatenate([from_z @ least.x[:n], least.x[n:size]])
        relaxation = program.violations(x)[relaxable]
        iterations = least.iterations + result.iterations
        return x, relaxation if relaxation.max() >= _NEGLIGIBLE else None, iterations


def _first_to_solve(solvers: Iterable[Solver], program: QuadraticProgram) -> SolverResult:
    """Return the first solution; if there is none, what the last solver says."""
    for solver in solvers:
        result = solver.solve(program)
        if result.status is Status.SOLVED:
            break
    return result


def _greatest_weight(tasks: Sequence[TaskTerm], wrench_tasks: Sequence[WrenchTerm]) -> float:
    """Return the largest weight; it is made 1, so that gamma keeps its sense."""
    greatest = 0.0
    for task in tasks:
        if task.weight > greatest:
            greatest = task.weight
    for wrench_task in wrench_tasks:
        if wrench_task.weight > greatest:
            greatest = wrench_task.weight
    if not greatest > 0.0:
        raise NoSolutionFound("no task with a weight above 0")
    return greatest
