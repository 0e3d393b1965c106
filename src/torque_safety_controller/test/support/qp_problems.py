# SPDX-License-Identifier: Apache-2.0
"""Random problems of the inverse-dynamics QP and their solutions by other means, for tests."""

from typing import NamedTuple

import numpy as np
import scipy.sparse as sparse
from proxsuite import proxqp
from scipy.optimize import lsq_linear, nnls

from torque_safety_controller.qp import (
    AccelerationRange,
    ContactForces,
    LinearConstraints,
    TaskTerm,
    WrenchTerm,
)

N = 7
GAMMA = 1e-4
KEPT = 1e-6  # rad/s^2, N m and N


class Problem(NamedTuple):
    tasks: list[TaskTerm]
    a_lower: np.ndarray
    a_upper: np.ndarray
    M: np.ndarray
    tau_lower: np.ndarray
    tau_upper: np.ndarray
    rows: LinearConstraints
    contacts: ContactForces

    @property
    def r(self) -> int:
        """Number of forces."""
        return len(self.contacts.rho_max)

    def cost(self) -> tuple[np.ndarray, np.ndarray]:
        """H and g of the cost in (a, rho), the largest weight made 1."""
        scale = max(t.weight for t in [*self.tasks, *self.contacts.tasks])
        H, g = GAMMA * np.eye(N + self.r), np.zeros(N + self.r)
        terms = [(np.eye(N) if A is None else A, b, weight, 0) for A, b, weight in self.tasks]
        terms += [(W, F, weight, N) for W, F, weight in self.contacts.tasks]
        for A, b, weight, first in terms:
            part = np.zeros((len(b), N + self.r))
            part[:, first : first + A.shape[1]] = A
            H += weight / scale * part.T @ part
            g -= weight / scale * part.T @ b
        return H, g

    def soft(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What may be relaxed: S, lower and upper of lower <= S a <= upper."""
        rows = self.rows
        lower, upper = np.r_[self.a_lower, rows.lower], np.r_[self.a_upper, rows.upper]
        return np.vstack([np.eye(N), rows.G]), lower, upper

    def hard(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Torques and forces: C, lower and upper of lower <= C (a, rho) <= upper."""
        C = np.block([[self.M, -self.contacts.B], [np.zeros((self.r, N)), np.eye(self.r)]])
        lower = np.r_[self.tau_lower, np.zeros(self.r)]
        return C, lower, np.r_[self.tau_upper, self.contacts.rho_max]

    def excess(self, a: np.ndarray) -> np.ndarray:
        """How far a is outside of bounds and rows, shape (n + k,)."""
        S, lower, upper = self.soft()
        return np.maximum(np.maximum(lower - S @ a, S @ a - upper), 0.0)


def solution_of(qp, problem: Problem):
    tasks, a_lower, a_upper, M, tau_lower, tau_upper, rows, contacts = problem
    bounds = AccelerationRange(a_lower, a_upper)
    return qp.solve(tasks, M, np.zeros(N), tau_lower, tau_upper, contacts, bounds, rows)


def random_problem(rng, k=0, r=0, room=1.0, scale=1.0, masses=1.0) -> Problem:
    """An arm's problem with k rows and r forces; with little room limits contradict each other.

    Of the bounds some leave no acceleration but 0, or hardly another, and some are infinite.
    """
    L = 0.5 * rng.normal(size=(N, N))
    middle, half = (1.0 - room) * 20.0 * rng.normal(size=N), room * rng.uniform(2.0, 50.0, N)
    a_lower, a_upper = -rng.uniform(1.0, 5.0, N), rng.uniform(1.0, 5.0, N)
    kind = rng.random(N)
    a_lower[kind < 0.1] = a_upper[kind < 0.1] = 0.0
    a_lower[(kind > 0.1) & (kind < 0.2)] = -1e-3
    a_upper[(kind > 0.15) & (kind < 0.25)] = np.inf
    shift = (1.0 - room) * 5.0 * rng.normal(size=k)
    lower = shift - room * rng.uniform(0.5, 5.0, k)
    upper = shift + room * rng.uniform(0.5, 5.0, k)
    one_sided = rng.random(k)
    lower[one_sided < 0.3] = -np.inf
    upper[one_sided > 0.7] = np.inf
    wrenches = [
        WrenchTerm(rng.normal(size=(6, r)), 10.0 * rng.normal(size=6), 0.5),
        WrenchTerm(rng.normal(size=(3, r)), 10.0 * rng.normal(size=3), 2.0),
    ]
    return Problem(
        [
            TaskTerm(rng.normal(size=(6, N)), 10.0 * scale * rng.normal(size=6), 3.0),
            TaskTerm(None, scale * rng.normal(size=N), 3e-2),
        ],
        a_lower,
        a_upper,
        masses * (L @ L.T + 0.05 * np.eye(N)),
        masses * (middle - half),
        masses * (middle + half),
        LinearConstraints(rng.normal(size=(k, N)), lower, upper),
        ContactForces(
            rng.normal(size=(N, r)),
            np.where(rng.random(r) < 0.2, 0.0, np.inf),
            wrenches if r else [],
        ),
    )


def by_proxqp(problem: Problem) -> np.ndarray | None:
    """Solve it in another form by another method; None where that does not converge.

    The torque is a variable of its own, with the dynamics as an equation.
    """
    r, rows = problem.r, problem.rows
    H, g = problem.cost()
    H = np.block([[H, np.zeros((N + r, N))], [np.zeros((N, N + r)), np.zeros((N, N))]])
    dynamics = np.hstack([problem.M, -problem.contacts.B, -np.eye(N)])
    C = np.vstack([np.eye(N + r + N), np.hstack([rows.G, np.zeros((len(rows.G), r + N))])])
    lower = np.r_[problem.a_lower, np.zeros(r), problem.tau_lower, rows.lower]
    upper = np.r_[problem.a_upper, problem.contacts.rho_max, problem.tau_upper, rows.upper]
    qp = proxqp.sparse.QP(N + r + N, N, len(lower))
    qp.settings.eps_abs, qp.settings.eps_rel = 1e-9, 0.0
    qp.settings.max_iter = 300
    qp.settings.eps_primal_inf = 1e-10
    H, dynamics, C = (sparse.csc_matrix(each) for each in (H, dynamics, C))
    qp.init(H, np.r_[g, np.zeros(N)], dynamics, np.zeros(N), C, lower, upper)
    qp.solve()
    solved = qp.results.info.status == proxqp.QPSolverOutput.PROXQP_SOLVED
    return np.array(qp.results.x)[: N + r] if solved else None


def least_relaxation(problem: Problem) -> np.ndarray:
    """How far bounds and rows have to give way at least, shape (n + k,).

    A least-squares problem in boxes: the torques, the forces, and the nearest values within the
    limits.
    """
    S, lower, upper = problem.soft()
    _, hard_lower, hard_upper = problem.hard()
    inverse = np.linalg.inv(problem.M)
    A = np.hstack([S @ inverse, S @ inverse @ problem.contacts.B, -np.eye(len(S))])
    lower, upper = np.r_[hard_lower, lower], np.r_[hard_upper, upper]
    fixed = lower == upper
    at_fixed = A[:, fixed] @ lower[fixed]
    box = lower[~fixed], upper[~fixed]
    found = lsq_linear(A[:, ~fixed], -at_fixed, box, method="bvls", tol=1e-14, max_iter=1000)
    return np.abs(A[:, ~fixed] @ found.x + at_fixed)


def assert_torques_and_forces_kept(problem: Problem, solution) -> None:
    C, lower, upper = problem.hard()
    value = C @ np.r_[solution.a, solution.rho]
    assert (value >= lower - KEPT).all()
    assert (value <= upper + KEPT).all()


def assert_tasks_served_best(problem: Problem, solution) -> None:
    """Karush-Kuhn-Tucker, with bounds and rows where they have been moved to."""
    x = np.r_[solution.a, solution.rho]
    S, soft_lower, soft_upper = problem.soft()
    hard, hard_lower, hard_upper = problem.hard()
    C = np.vstack([np.hstack([S, np.zeros((len(S), problem.r))]), hard])
    at_lower = C @ x < np.r_[soft_lower, hard_lower] + KEPT
    at_upper = C @ x > np.r_[soft_upper, hard_upper] - KEPT
    H, g = problem.cost()
    normals = np.vstack([C[at_lower], -C[at_upper]]).T
    slope = H @ x + g
    left = nnls(normals, slope)[1] if normals.size else np.linalg.norm(slope)
    assert left < 1e-5 * (1.0 + np.linalg.norm(g))
