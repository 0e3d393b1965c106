# SPDX-License-Identifier: Apache-2.0
"""The QP of a control step, solved by least relaxation where its limits contradict each other.

The torque limits together with the acceleration bounds and the constraints on G a may have no
solution. Then the torque limits are kept, and bounds and constraints are relaxed as little as
possible, in the sense of least squares.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torque_safety_controller.qp.active_set import write_and_solve
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
        self._nothing = np.zeros((0, n), order="F"), np.zeros(0), 0.0
        self._no_joints = TaskTerm(None, np.zeros(n), 0.0)
        self._arrays: dict[tuple[int, int], tuple[QuadraticProgram, NDArray[np.int32]]] = {}

    def solve(
        self,
        tasks: Sequence[TaskTerm],
        M: Array,
        h: Array,
        tau_min: Array,
        tau_max: Array,
        contacts: ContactForces | None,
        bounds: AccelerationRange,
        constraints: LinearConstraints | None,
    ) -> Solution:
        """Return the accelerations and forces that serve the tasks best within the limits.

        The program is in x = (a, rho), with C = (M, -B; G, 0). Solvers are asked where the limits
        active last are not those active now, as a linear system tells in much less time.

        Args:
            tasks: at least one.
            M: mass matrix, shape (n, n).
            h: torque of the motors besides M a - B rho, shape (n,), N m.
            tau_min: lower limits of the motors' torques, shape (n,), N m.
            tau_max: upper limits, shape (n,), N m.
            contacts: what the environment can exert; None for nothing.
            bounds: of the accelerations.
            constraints: on the accelerations besides; None for none.

        Raises:
            NoSolutionFound: numbers that are not finite or absurd, limits that are crossed, or no
                task with a weight.
            ValueError: constraints or contacts of the wrong shape.
        """
        n = self._n
        program, active = self._program(constraints, contacts)
        A, b, weight, b_joints, weight_joints = self._cost(tasks, contacts)
        x = np.empty(len(program.g))
        if write_and_solve(
            *program, active, x, self._gamma, *bounds, M, h, tau_min, tau_max,
            A, b, weight, b_joints, weight_joints,
        ):  # fmt: skip
            a, rho = (x, _NO_FORCES) if contacts is None else (x[:n], x[n:])
            return Solution(a, rho, None, None, 1)
        for solver in self._solvers:
            result = solver.solve(program)
            if result.status is not Status.FAILED:
                break
        x, iterations = result.x, result.iterations
        relaxation = constraint_relaxation = None
        if result.status is Status.SOLVED:
            active[:] = 0 if result.active is None else result.active
        elif result.status is Status.INFEASIBLE:
            x, iterations = self._relaxed(program)
            violations = program.violations(x)
            of_bounds, of_rows = violations[:n], violations[len(x) + n :]
            if max(of_bounds.max(), of_rows.max(initial=0.0)) >= _NEGLIGIBLE:
                relaxation, constraint_relaxation = of_bounds, of_rows
        else:
            raise NoSolutionFound("not finite, absurd, or lower limits above upper ones", program)
        return Solution(x[:n], x[n:], relaxation, constraint_relaxation, iterations)

    def _program(
        self, constraints: LinearConstraints | None, contacts: ContactForces | None
    ) -> tuple[QuadraticProgram, NDArray[np.int32]]:
        """Return a program with constraints and contacts, and what was active in the last.

        All of a size are in the same arrays.
        """
        n, k, r = self._n, 0, 0
        if constraints is not None:
            G, row_lower, row_upper = constraints
            k = len(G)
            if G.shape != (len(row_lower), n) or row_lower.shape != row_upper.shape:
                raise ValueError(
                    f"constraints on {n} joints with G {G.shape}, lower {row_lower.shape}, "
                    f"upper {row_upper.shape}"
                )
        if contacts is not None:
            r = len(contacts.rho_max)
            if contacts.B.shape != (n, r):
                shapes = f"B {contacts.B.shape}, rho_max {contacts.rho_max.shape}"
                raise ValueError(f"forces on {n} joints with {shapes}")
        if (k, r) not in self._arrays:
            H, g, C = np.zeros((n + r, n + r)), np.zeros(n + r), np.zeros((n + k, n + r))
            lower, upper = np.zeros((2, n + r + n + k))
            program = QuadraticProgram(H, g, C, lower, upper)
            self._arrays[k, r] = program, np.zeros(len(lower), dtype=np.int32)
        program, active = self._arrays[k, r]
        if constraints is not None:
            program.C[n:, :n] = G
            program.lower[r + 2 * n :], program.upper[r + 2 * n :] = row_lower, row_upper
        if contacts is not None:
            program.C[:n, n:], program.upper[n : n + r] = -contacts.B, contacts.rho_max
        return program, active

    def _cost(
        self, tasks: Sequence[TaskTerm], contacts: ContactForces | None
    ) -> tuple[Array, Array, float, Array, float]:
        """Return A, b, weight, and b and weight of the joints, as `write_and_solve` takes them."""
        # Mostly the last task is of the joints, and there is at most one before it.
        others, (_, b_joints, weight_joints) = list(tasks), self._no_joints
        if others and others[-1].A is None:
            _, b_joints, weight_joints = others.pop()
        A, b, weight = others[0] if others else self._nothing
        greatest = max(weight, weight_joints)
        if contacts is not None or len(others) > 1 or A is None:
            A, b, weights = self._stacked(others, contacts)
            weight, greatest = 1.0, max([greatest, *weights])
        if not greatest > 0.0:
            raise NoSolutionFound("no task with a weight above 0")
        return A, b, weight / greatest, b_joints, weight_joints / greatest

    def _stacked(
        self, tasks: Sequence[TaskTerm], contacts: ContactForces | None
    ) -> tuple[Array, Array, list[float]]:
        """Return terms of accelerations and forces as one of weight 1: A, b; and their weights."""
        n, r = self._n, 0 if contacts is None else len(contacts.rho_max)
        terms = [(np.eye(n) if A is None else A, b, weight, 0) for A, b, weight in tasks]
        for W, F_des, weight in () if contacts is None else contacts.tasks:
            if W.shape != (*F_des.shape, r):
                shapes = f"W {W.shape}, F_des {F_des.shape}"
                raise ValueError(f"wrench task of {r} forces, {shapes}")
            terms.append((W, F_des, weight, n))
        A, b = np.zeros((sum(len(each[1]) for each in terms), n + r), order="F"), [np.zeros(0)]
        for part, wanted, weight, first in terms:
            root = math.sqrt(max(weight, 0.0))
            row = sum(map(len, b))
            A[row : row + len(wanted), first : first + part.shape[1]] = root * part
            b.append(root * wanted)
        return A, np.concatenate(b), [weight for *_, weight, _ in terms]

    def _relaxed(self, program: QuadraticProgram) -> tuple[Array, int]:
        """Return the solution with bounds and constraints relaxed least, and the iterations."""
        relaxed, least_x, iterations = relaxed_least(program, self._n, self._relaxing_solvers)
        result = first_to_solve(self._relaxed_solvers, relaxed)
        # Where too little room is left for the tasks, what relaxes least keeps the limits, too.
        x = result.x if result.status is Status.SOLVED else least_x
        return x, iterations + result.iterations
