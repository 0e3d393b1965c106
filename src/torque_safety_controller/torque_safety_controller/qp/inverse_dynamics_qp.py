"""The QP for joint accelerations and contact forces: eq. (5) of [Benallegue2021].

    minimise    sum_t w_t |A_t a - b_t|^2 + sum_c w_c |W_c rho - F_c|^2 + gamma (|a|^2 + |rho|^2)
    subject to  a_lower <= a <= a_upper,   lower <= G a <= upper,   0 <= rho <= rho_max,
                tau_min <= M a + h - B rho <= tau_max.

Without contacts it is eq. (33) of [DelPrete2018]. Torques are eliminated by the dynamics. The
torque rows always have a solution, without force, as M is regular; together with the bounds of
the accelerations and the rows G a they may not. Then the torque rows win, and bounds and rows
give way as little as possible, in the sense of least squares.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from torque_safety_controller.linalg.dense_kernels import add_identity, add_rows, clear_cost
from torque_safety_controller.qp import active_set, proxqp_solver
from torque_safety_controller.qp.active_set import FAILED, INFEASIBLE, write_dynamics
from torque_safety_controller.qp.constraints import Rows
from torque_safety_controller.tasks.tasks import TaskTerm, WrenchTerm
from viability_bounds_pkg.exceptions import ArmSafetyError

# Weight of |x|^2 beside the squared relaxation: what it adds to the least is of this order.
_RELAXED_REGULARISATION = 1e-10
# Room that is left to the tasks beyond the least relaxation, relative to it where it is above 1.
_ROOM = 1e-8
_NEGLIGIBLE = 1e-6
"""Less relaxation than this, rad/s^2, is none."""


SOLVERS = {"active_set": active_set.minimise, "proxqp": proxqp_solver.minimise}
"""By name: our own, which starts from the limits that were active last, and ProxQP."""


class ContactForces(NamedTuple):
    """Forces of the environment on the arm, W rho with rho >= 0."""

    B: np.ndarray
    """What rho adds to the joint torques, the sum of J' W: shape (n, r)."""
    rho_max: np.ndarray
    """Shape (r,), N: inf, or 0 for contacts that are open."""
    tasks: Sequence[WrenchTerm] = ()
    """What the forces should be."""


class Solution(NamedTuple):
    """What the QP returned."""

    a: np.ndarray
    """Accelerations, shape (n,), rad/s^2."""
    relaxation: np.ndarray | None
    """By how much bounds gave way, shape (n,), rad/s^2; None when nothing had to."""
    iterations: int
    """Changes of the active constraints, from those of the last solution."""
    row_relaxation: np.ndarray | None = None
    """By how much rows gave way, shape (k,), in their units; None when nothing had to."""
    rho: np.ndarray | None = None
    """Coefficients of the contact forces, shape (r,), N; None without contacts."""
    contact_torque: np.ndarray | None = None
    """B rho, shape (n,), N m: the motors give M a + h minus this; None without contacts."""


class NoSolutionFound(ArmSafetyError, RuntimeError):
    """The solver was given values that are not finite, crossed, or absurd."""


class InverseDynamicsQP:
    """Assembles and solves the QP; the limits active in the last solution are tried first.

    Args:
        n: number of joints.
        gamma: weight of |x|^2, relative to the largest task weight; keeps the solution unique.
        solver: one of `SOLVERS`. Where ``active_set`` gives up, ProxQP is asked; by how much
            limits must give way, ``active_set`` finds, because ProxQP cannot tell for certain.
    """

    def __init__(self, n: int, gamma: float = 1e-6, solver: str = "active_set") -> None:
        self._n = n
        self._gamma = gamma
        self._minimise = SOLVERS[solver]
        self._no_rows = Rows(np.zeros((0, n)), np.zeros(0), np.zeros(0))
        self._no_contacts = ContactForces(np.zeros((n, 0)), np.zeros(0))
        self._side = np.zeros(0)
        self._size = (-1, -1)
        # Compiled now, not in the first step in which limits must give way.
        one = np.ones(1)
        active_set.minimise(np.eye(1), one, np.zeros((0, 1)), -one, one, np.zeros(1), np.zeros(1))

    def solve(
        self,
        tasks: Sequence[TaskTerm],
        a_lower: np.ndarray,
        a_upper: np.ndarray,
        M: np.ndarray,
        tau_lower: np.ndarray,
        tau_upper: np.ndarray,
        rows: Rows | None = None,
        contacts: ContactForces | None = None,
    ) -> Solution:
        """Return the accelerations and forces that serve the tasks best within the limits.

        Args:
            tasks: at least one.
            a_lower: shape (n,), rad/s^2.
            a_upper: shape (n,), rad/s^2, not below `a_lower`.
            M: mass matrix, shape (n, n).
            tau_lower: lower limits of M a - B rho, bias torque subtracted, shape (n,), N m.
            tau_upper: upper limits of M a - B rho, shape (n,), N m.
            rows: further constraints on the accelerations; their number may change.
            contacts: what the environment can exert; the number of forces may change.

        Raises:
            NoSolutionFound: numbers that are not finite, limits that are crossed, or no weight.
            ValueError: rows or contacts of the wrong shape.
        """
        rows = self._no_rows if rows is None else self._checked_rows(rows)
        forces = self._no_contacts if contacts is None else self._checked_forces(contacts)
        self._resize(len(forces.rho_max), len(rows.lower))
        self._assemble(tasks, forces.tasks)
        x = np.empty(self._n + len(forces.rho_max))
        write_dynamics(
            self._C,
            self._lower,
            self._upper,
            a_lower,
            a_upper,
            forces.rho_max,
            M,
            forces.B,
            tau_lower,
            tau_upper,
            *rows,
        )
        problem = self._H, self._g, self._C, self._lower, self._upper, self._side, x
        iterations = self._minimise(*problem)
        if iterations == FAILED:
            iterations = proxqp_solver.minimise(*problem)
        relaxation = row_relaxation = None
        if iterations == INFEASIBLE:
            relaxation, row_relaxation, iterations = self._relax(x)
        elif iterations == FAILED:
            raise NoSolutionFound("not finite, absurd, or lower limits above upper ones")
        if contacts is None:
            return Solution(x, relaxation, iterations, row_relaxation)
        a, rho = x[: self._n], x[self._n :]
        return Solution(a, relaxation, iterations, row_relaxation, rho, forces.B @ rho)

    def _checked_rows(self, rows: Rows) -> Rows:
        """Return `rows` in the one layout that the kernels are compiled for."""
        G, lower, upper = (np.ascontiguousarray(each, dtype=float) for each in rows)
        if G.shape != (len(lower), self._n) or lower.shape != upper.shape or lower.ndim != 1:
            raise ValueError(
                f"rows of {self._n} joints with G {G.shape}, lower {lower.shape}, "
                f"upper {upper.shape}"
            )
        return Rows(G, lower, upper)

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

    def _resize(self, r: int, k: int) -> None:
        """Make room for r forces and k rows; what was active is kept where it still exists."""
        if (r, k) == self._size:
            return
        n, size = self._n, self._n + r
        side = np.zeros(size + n + k)
        if self._size[0] == r:
            common = min(len(side), len(self._side))
            side[:common] = self._side[:common]
        self._size = (r, k)
        self._side = side
        self._relaxed_side = np.zeros(size + 3 * n + 2 * k)
        self._H, self._g = np.zeros((size, size)), np.zeros(size)
        self._C = np.zeros((n + k, size))
        self._lower, self._upper = np.zeros(len(side)), np.zeros(len(side))

    def _assemble(self, tasks: Sequence[TaskTerm], wrench_tasks: Sequence[WrenchTerm]) -> None:
        """Fill H and g; the largest weight becomes 1, so that gamma keeps its sense."""
        greatest = 0.0
        for _, _, weight in tasks:
            if weight > greatest:
                greatest = weight
        for _, _, weight, _ in wrench_tasks:
            if weight > greatest:
                greatest = weight
        if not greatest > 0.0:
            raise NoSolutionFound("no task with a weight above 0")
        scale = 1.0 / greatest
        H, g = self._H, self._g
        clear_cost(H, g, self._gamma)
        for A, b, weight in tasks:
            if A is None:
                add_identity(H, g, b, weight * scale)
            else:
                add_rows(H, g, A, b, weight * scale, 0)
        for W, F_des, weight, first in wrench_tasks:
            add_rows(H, g, W, F_des, weight * scale, self._n + first)

    def _relax(self, x: np.ndarray) -> tuple[np.ndarray | None, np.ndarray | None, int]:
        """Solve with bounds and rows moved by the least that leaves a solution.

        First, in the variables (x, e), with S x what may give way, the bounded and G a:

            minimise |e|^2 + epsilon |x|^2   subject to   S x - e, rho and the torques in limits;

        then the QP itself, with the limits moved by e.
        """
        n, (r, k) = self._n, self._size
        size, soft = n + r, n + k
        S = np.zeros((soft, size))
        S[:n, :n] = np.eye(n)
        S[n:] = self._C[n:]
        H = np.diag(np.r_[np.full(size, _RELAXED_REGULARISATION), np.ones(soft)])
        C = np.zeros((n + soft, size + soft))
        C[:n, :size] = self._C[:n]
        C[n:, :size] = S
        C[n:, size:] = -np.eye(soft)
        given = np.r_[:n, size + n : size + n + k]  # where the limits of S x are
        no = np.full(soft, np.inf)
        tau = slice(size, size + n)
        lower, upper = self._lower, self._upper
        free = np.full(n, np.inf)
        y = np.empty(size + soft)
        first = active_set.minimise(
            H,
            np.zeros(size + soft),
            C,
            np.r_[-free, lower[n:size], -no, lower[tau], lower[given]],
            np.r_[free, upper[n:size], no, upper[tau], upper[given]],
            self._relaxed_side,
            y,
        )
        if first < 0:
            raise NoSolutionFound("no accelerations within the torque limits were found")
        e = y[size:]
        room = _ROOM * max(1.0, float(np.abs(e).max()))
        moved_lower, moved_upper = lower.copy(), upper.copy()
        moved_lower[given] += np.minimum(e, 0.0) - room
        moved_upper[given] += np.maximum(e, 0.0) + room
        second = active_set.minimise(
            self._H, self._g, self._C, moved_lower, moved_upper, self._side, x
        )
        if second < 0:
            raise NoSolutionFound("no accelerations were found, even with bounds relaxed")
        value = S @ x
        relaxation = np.maximum(lower[given] - value, value - upper[given]).clip(0.0)
        if relaxation.max() < _NEGLIGIBLE:
            return None, None, first + second
        return relaxation[:n], relaxation[n:], first + second
