# SPDX-License-Identifier: Apache-2.0
"""Random problems of the inverse-dynamics QP and their solutions by other means, for tests."""

from typing import NamedTuple

import numpy as np
from scipy.linalg import cholesky, solve_triangular
from scipy.optimize import lsq_linear, nnls

from torque_safety_controller.qp import (
    AccelerationRange,
    ContactForces,
    LinearConstraints,
    TaskTerm,
)

N = 7
GAMMA = 1e-6
ACCELERATION_TOLERANCE = 1e-6  # rad/s^2
TORQUE_TOLERANCE = 1e-6  # N m
NEAR = 1e-3  # rad/s^2; a cost counts as the least if moving so far could have lowered it so
LONG = 1.0  # s; the solver gives up after a hundredth of it


class Problem(NamedTuple):
    tasks: list[TaskTerm]
    a_lower: np.ndarray
    a_upper: np.ndarray
    M: np.ndarray
    tau_lower: np.ndarray
    tau_upper: np.ndarray
    rows: LinearConstraints | None = None
    contacts: ContactForces | None = None

    def cost(self) -> tuple[np.ndarray, np.ndarray]:
        """H and g of the cost, the largest weight made 1."""
        scale = 1.0 / max(task.weight for task in self.tasks)
        H, g = GAMMA * np.eye(N), np.zeros(N)
        for A, b, weight in self.tasks:
            A = np.eye(N) if A is None else A
            H += scale * weight * A.T @ A
            g -= scale * weight * A.T @ b
        return H, g


def built(qp, problem: Problem):
    tasks, a_lower, a_upper, *limits = problem
    return qp.build(tasks, AccelerationRange(a_lower, a_upper), *limits)


def solution_of(qp, problem: Problem):
    return qp.solve(built(qp, problem))


def random_problem(rng, room=1.0, scale=1.0) -> Problem:
    """An arm's problem; with little room many have no solution without relaxation."""
    L = 0.5 * rng.normal(size=(N, N))
    J = rng.normal(size=(6, N))
    middle = (1.0 - room) * 20.0 * rng.normal(size=N)
    half = room * rng.uniform(2.0, 50.0, N)
    return Problem(
        [
            TaskTerm(J, 10.0 * scale * rng.normal(size=6), 3.0),
            TaskTerm(None, scale * rng.normal(size=N), 3e-3),
        ],
        -rng.uniform(1.0, 5.0, N),
        rng.uniform(1.0, 5.0, N),
        L @ L.T + 0.05 * np.eye(N),
        middle - half,
        middle + half,
    )


def least_distance(H, g, C, d) -> np.ndarray | None:
    """Minimise x'Hx/2 + g'x subject to C x <= d by Lawson and Hanson's reduction to NNLS.

    None without a solution. It shares nothing with the solver under test.
    """
    R = cholesky(H)
    shift = solve_triangular(R, g, trans=1)
    G = -solve_triangular(R, C.T, trans=1).T
    h = -(d + solve_triangular(R, C.T, trans=1).T @ shift)
    E = np.vstack([G.T, h])
    f = np.zeros(len(E))
    f[-1] = 1.0
    u, distance = nnls(E, f, maxiter=1000)
    r = E @ u - f
    if distance < 1e-7:
        return None
    return solve_triangular(R, -r[:-1] / r[-1] - shift)


def reference(problem: Problem, widen=0.0) -> np.ndarray | None:
    H, g = problem.cost()
    eye = np.eye(N)
    C = np.vstack([eye, -eye, problem.M, -problem.M])
    d = np.concatenate([problem.a_upper, -problem.a_lower, problem.tau_upper, -problem.tau_lower])
    finite = np.isfinite(d)
    return least_distance(H, g, C[finite], d[finite] + widen)


def least_relaxation(problem: Problem) -> np.ndarray:
    """How far the nearest accelerations that the motors can give are outside the bounds.

    A least-squares problem in boxes: the torques M a, and the point of the bounds next to a.
    """
    A = np.hstack([np.linalg.inv(problem.M), -np.eye(N)])
    lower = np.concatenate([problem.tau_lower, problem.a_lower])
    upper = np.concatenate([problem.tau_upper, problem.a_upper])
    found = lsq_linear(A, np.zeros(N), (lower, upper), method="bvls", tol=1e-14, max_iter=1000)
    return A @ found.x


def excess(problem: Problem, a: np.ndarray) -> np.ndarray:
    return np.maximum(np.maximum(problem.a_lower - a, a - problem.a_upper), 0.0)


def assert_torques_kept(problem: Problem, a: np.ndarray) -> None:
    tau = problem.M @ a
    assert (tau >= problem.tau_lower - TORQUE_TOLERANCE).all()
    assert (tau <= problem.tau_upper + TORQUE_TOLERANCE).all()


def assert_cost_is_least(problem: Problem, a: np.ndarray, best: np.ndarray) -> None:
    H, g = problem.cost()
    excess_cost = 0.5 * (a @ H @ a - best @ H @ best) + g @ (a - best)
    assert excess_cost < NEAR * np.linalg.norm(H @ best + g) + NEAR**2 * np.trace(H)


# From Baxter in the middle of a run, three joints at their limits, pulled hard.
LITTLE_ROOM = Problem(
    [
        TaskTerm(
            np.array(
                [
                    [-0.8437, -0.5147, 0.2832, 0.2894, 0.06856, -0.1188, 0.0],
                    [-0.4136, 0.9839, 0.1117, -0.6929, 0.02211, 0.3685, 0.0],
                    [0.02297, -0.1776, -0.002851, 0.08876, 0.0, 0.0, 0.0],
                    [0.3696, -0.8888, -0.1465, 0.9234, -0.06502, -0.9517, 0.0],
                    [-0.7819, -0.4551, 0.3947, 0.3834, 0.2016, -0.3069, 0.0],
                    [-0.5021, 0.05447, 0.9071, -0.01767, 0.9773, 0.0, 1.0],
                ]
            ),
            np.array([952.7, -635.0, -543.0, 82.82, 761.2, 17.73]),
            1.0,
        ),
        TaskTerm(None, np.array([9.167, 3.895, -0.7992, -9.537, 0.7991, -4.948, 24.58]), 1e-3),
    ],
    np.array([4.357e-03, -3.0, -10.9, -15.0, -15.0, -15.0, -0.9936]),
    np.array([5.0, 3.0, -7.932e-04, 3.705e-03, -2.695e-02, 15.0, 15.0]),
    np.array(
        [
            [2.509, 0.05143, -0.5865, 0.0799, -0.05236, -0.03626, -0.02088],
            [0.05143, 3.505, -0.07796, -1.478, -0.01562, 0.2931, 0.004666],
            [-0.5865, -0.07796, 0.2063, 0.008431, 0.05344, 0.00501, 0.03691],
            [0.0799, -1.478, 0.008431, 0.8111, 0.007311, -0.1949, -0.00223],
            [-0.05236, -0.01562, 0.05344, 0.007311, 0.04943, -0.0002561, 0.03969],
            [-0.03626, 0.2931, 0.00501, -0.1949, -0.0002561, 0.09254, 0.0005197],
            [-0.02088, 0.004666, 0.03691, -0.00223, 0.03969, 0.0005197, 0.04058],
        ]
    ),
    np.array([-43.01, -15.06, -52.18, -61.39, -15.17, -13.17, -14.91]),
    np.array([56.99, 84.94, 47.82, 38.61, 14.83, 16.83, 15.09]),
)
