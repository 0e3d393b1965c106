# SPDX-License-Identifier: Apache-2.0
"""The QP with contact forces and further rows, against solvers of other kinds."""

import numpy as np
import pytest
import scipy.sparse as sparse
from proxsuite import proxqp
from qp_problems import Problem, solution_of
from scipy.optimize import lsq_linear, nnls

from torque_safety_controller.qp import (
    ContactForces,
    InverseDynamicsQP,
    LinearConstraints,
    NoSolutionFound,
    TaskTerm,
    WrenchTerm,
)

N = 9
GAMMA = 1e-4
KEPT = 1e-6  # rad/s^2, N m and N


def random_problem(rng, k=10, r=8, room=1.0) -> Problem:
    """With little room, torques and bounds, or rows and bounds, contradict each other."""
    L = 0.5 * rng.normal(size=(N, N))
    G = rng.normal(size=(k, N))
    lower, upper = -room * rng.uniform(0.5, 5.0, k), room * rng.uniform(0.5, 5.0, k)
    shift = (1.0 - room) * 5.0 * rng.normal(size=k)
    one_sided = rng.random(k)
    lower, upper = lower + shift, upper + shift
    lower[one_sided < 0.3] = -np.inf
    upper[one_sided > 0.7] = np.inf
    middle = (1.0 - room) * 20.0 * rng.normal(size=N)
    half = room * rng.uniform(2.0, 30.0, N)
    rho_max = np.where(rng.random(r) < 0.2, 0.0, np.inf)
    wrenches = [
        WrenchTerm(rng.normal(size=(6, r)), 10.0 * rng.normal(size=6), 0.5),
        WrenchTerm(rng.normal(size=(3, r)), 10.0 * rng.normal(size=3), 2.0),
    ]
    return Problem(
        [
            TaskTerm(rng.normal(size=(6, N)), 10.0 * rng.normal(size=6), 3.0),
            TaskTerm(None, rng.normal(size=N), 3e-2),
        ],
        -rng.uniform(1.0, 5.0, N),
        rng.uniform(1.0, 5.0, N),
        L @ L.T + 0.05 * np.eye(N),
        middle - half,
        middle + half,
        LinearConstraints(G, lower, upper),
        ContactForces(rng.normal(size=(N, r)), rho_max, wrenches if r else []),
    )


def cost_of(problem: Problem):
    """H and g of the cost in (a, rho), the largest weight made 1."""
    r = len(problem.contacts.rho_max)
    scale = max(t.weight for t in [*problem.tasks, *problem.contacts.tasks])
    H, g = GAMMA * np.eye(N + r), np.zeros(N + r)
    terms = [(A, b, weight, 0) for A, b, weight in problem.tasks]
    terms += [(W, F, weight, N) for W, F, weight in problem.contacts.tasks]
    for A, b, weight, first in terms:
        A = np.eye(N) if A is None else A
        part = np.zeros((len(b), N + r))
        part[:, first : first + A.shape[1]] = A
        H += weight / scale * part.T @ part
        g -= weight / scale * part.T @ b
    return H, g


def by_proxqp(problem: Problem):
    """a and rho with the torque as a variable of its own, and by an augmented Lagrangian.

    Variables (a, rho, tau) with the dynamics as an equation. None without a solution.
    """
    rows, contacts = problem.rows, problem.contacts
    r, k = len(contacts.rho_max), len(rows.lower)
    H, g = cost_of(problem)
    H = np.block([[H, np.zeros((N + r, N))], [np.zeros((N, N + r)), np.zeros((N, N))]])
    g = np.r_[g, np.zeros(N)]
    dynamics = np.hstack([problem.M, -contacts.B, -np.eye(N)])
    C = np.vstack([np.eye(N + r + N), np.hstack([rows.G, np.zeros((k, r + N))])])
    lower = np.r_[problem.a_lower, np.zeros(r), problem.tau_lower, rows.lower]
    upper = np.r_[problem.a_upper, contacts.rho_max, problem.tau_upper, rows.upper]
    qp = proxqp.sparse.QP(N + r + N, N, len(lower))
    qp.settings.eps_abs = 1e-9
    qp.settings.eps_rel = 0.0
    qp.settings.max_iter = 300
    qp.settings.eps_primal_inf = 1e-10
    qp.init(
        sparse.csc_matrix(H),
        g,
        sparse.csc_matrix(dynamics),
        np.zeros(N),
        sparse.csc_matrix(C),
        lower,
        upper,
    )
    qp.solve()
    if qp.results.info.status != proxqp.QPSolverOutput.PROXQP_SOLVED:
        return None
    x = np.array(qp.results.x)
    return x[: N + r]


def least_relaxation(problem: Problem) -> np.ndarray:
    """How far bounds and rows have to give way, shape (n + k,), as least squares in boxes.

    In the torques, the forces, and the nearest values within the limits.
    """
    rows, contacts = problem.rows, problem.contacts
    S = np.vstack([np.eye(N), rows.G])
    inverse = np.linalg.inv(problem.M)
    A = np.hstack([S @ inverse, S @ inverse @ contacts.B, -np.eye(len(S))])
    r = len(contacts.rho_max)
    lower = np.r_[problem.tau_lower, np.zeros(r), problem.a_lower, rows.lower]
    upper = np.r_[problem.tau_upper, contacts.rho_max + 1e-9, problem.a_upper, rows.upper]
    found = lsq_linear(A, np.zeros(len(S)), (lower, upper), method="bvls", tol=1e-14)
    return A @ found.x


def excess(problem: Problem, a: np.ndarray) -> np.ndarray:
    value = np.r_[a, problem.rows.G @ a]
    lower = np.r_[problem.a_lower, problem.rows.lower]
    upper = np.r_[problem.a_upper, problem.rows.upper]
    return np.maximum(np.maximum(lower - value, value - upper), 0.0)


def assert_tasks_served_best(problem: Problem, solution) -> None:
    """Karush-Kuhn-Tucker, with limits where they have been moved to."""
    x = np.r_[solution.a, solution.rho]
    H, g = cost_of(problem)
    contacts, rows = problem.contacts, problem.rows
    r = len(solution.rho)
    C = np.vstack(
        [
            np.eye(N + r),
            np.hstack([problem.M, -contacts.B]),
            np.hstack([rows.G, np.zeros((len(rows.G), r))]),
        ]
    )
    lower = np.r_[problem.a_lower, np.zeros(r), problem.tau_lower, rows.lower]
    upper = np.r_[problem.a_upper, contacts.rho_max, problem.tau_upper, rows.upper]
    at_lower, at_upper = C @ x < lower + KEPT, C @ x > upper - KEPT
    slope = H @ x + g
    _, left = nnls(np.vstack([C[at_lower], -C[at_upper]]).T, slope)
    assert left < 1e-5 * (1.0 + np.linalg.norm(g))


def assert_hard_limits_kept(problem: Problem, solution) -> None:
    rho = solution.rho
    assert (rho >= 0.0).all()
    assert (rho <= problem.contacts.rho_max).all()
    tau = problem.M @ solution.a - problem.contacts.B @ rho
    assert (tau >= problem.tau_lower - KEPT).all()
    assert (tau <= problem.tau_upper + KEPT).all()


@pytest.mark.parametrize(("k", "r"), [(10, 8), (0, 8), (10, 0), (20, 24)])
def test_agrees_with_another_solver_on_another_form(k, r):
    rng = np.random.default_rng(1)
    qp = InverseDynamicsQP(N, GAMMA)  # one solver, as in the loop: each starts from the last
    solved = limited = pushed = 0
    for _ in range(60):
        problem = random_problem(rng, k, r)
        other = by_proxqp(problem)
        solution = solution_of(qp, problem)
        assert_hard_limits_kept(problem, solution)
        assert solution.relaxation is None and solution.constraint_relaxation is None
        assert excess(problem, solution.a).max() < KEPT
        assert_tasks_served_best(problem, solution)
        if other is None:
            continue  # it has not converged
        solved += 1
        x = np.r_[solution.a, solution.rho]
        np.testing.assert_allclose(x, other, atol=2e-2)
        value = problem.rows.G @ solution.a
        near = np.minimum(value - problem.rows.lower, problem.rows.upper - value) < KEPT
        limited += near.any()
        pushed += (solution.rho > 1e-3).any()
    assert solved > 30
    assert limited > 0.3 * solved or k == 0
    assert pushed > 0.3 * solved or r == 0


@pytest.mark.parametrize("room", [0.3, 0.05])
def test_torques_win_and_rows_and_bounds_give_way_together_by_the_least(room):
    rng = np.random.default_rng(2)
    qp = InverseDynamicsQP(N, GAMMA)
    relaxed = rows_relaxed = 0
    for _ in range(40):
        problem = random_problem(rng, 10, 4, room)
        needed = least_relaxation(problem)
        if np.abs(needed).max() < 1e-2:
            continue
        relaxed += 1
        solution = solution_of(qp, problem)
        assert_hard_limits_kept(problem, solution)
        relaxation = np.r_[solution.relaxation, solution.constraint_relaxation]
        np.testing.assert_allclose(relaxation, excess(problem, solution.a), atol=1e-9)
        np.testing.assert_allclose(relaxation, np.abs(needed), atol=1e-4)
        rows_relaxed += solution.constraint_relaxation.max() > 1e-2
        assert_tasks_served_best(problem, solution)
    assert relaxed > 20
    assert rows_relaxed > 10


def test_a_dearer_row_gives_way_less():
    problem = random_problem(np.random.default_rng(3), 1, 0)
    G = np.zeros((1, N))
    G[0, 2] = 1.0
    given = {}
    for factor in (1.0, 10.0):
        row = LinearConstraints(
            factor * G, factor * np.array([problem.a_upper[2] + 1.0]), np.array([np.inf])
        )
        no = np.full(N, 1e6)
        solution = solution_of(
            InverseDynamicsQP(N),
            problem._replace(rows=row, tau_lower=-no, tau_upper=no, contacts=None),
        )
        given[factor] = solution.relaxation[2], solution.constraint_relaxation[0] / factor
    np.testing.assert_allclose(given[1.0], [0.5, 0.5], atol=1e-5)
    np.testing.assert_allclose(given[10.0], [100.0 / 101.0, 1.0 / 101.0], atol=1e-5)


@pytest.mark.parametrize("factor", [1e-4, 1e4])
def test_rows_of_any_usual_length_have_a_solution(factor):
    rng = np.random.default_rng(10)
    for _ in range(60):
        problem = random_problem(rng, 8, 4, 0.3)
        rows = problem.rows._replace(G=factor * problem.rows.G)
        problem = problem._replace(rows=rows)
        solution = solution_of(InverseDynamicsQP(N, GAMMA), problem)
        assert_hard_limits_kept(problem, solution)


def test_sizes_may_change_from_step_to_step():
    rng = np.random.default_rng(4)
    qp = InverseDynamicsQP(N, GAMMA)
    repeated = spared = 0
    for _ in range(60):
        problem = random_problem(rng, int(rng.integers(0, 12)), int(rng.integers(0, 3)) * 4)
        if rng.random() < 0.3:
            problem = problem._replace(rows=None)
        if rng.random() < 0.3:
            problem = problem._replace(contacts=None)
        used, fresh = solution_of(qp, problem), solution_of(InverseDynamicsQP(N, GAMMA), problem)
        np.testing.assert_allclose(used.a, fresh.a, atol=1e-6)
        np.testing.assert_allclose(used.rho, fresh.rho, atol=1e-5)
        if used.relaxation is None:
            repeated += 1
            spared += solution_of(qp, problem).iterations == 1
    assert spared == repeated > 20


def test_without_rows_and_forces_nothing_changes():
    rng = np.random.default_rng(5)
    for _ in range(20):
        problem = random_problem(rng, 0, 0)
        plain = solution_of(InverseDynamicsQP(N, GAMMA), problem[:6])
        empty = solution_of(InverseDynamicsQP(N, GAMMA), problem)
        np.testing.assert_allclose(plain.a, empty.a, atol=1e-9)
        assert len(plain.rho) == 0
        assert plain.constraint_relaxation is None or not len(plain.constraint_relaxation)


def test_any_layout_of_rows_will_do():
    problem = random_problem(np.random.default_rng(6))
    expected = solution_of(InverseDynamicsQP(N, GAMMA), problem)
    rows = problem.rows._replace(G=np.asfortranarray(problem.rows.G))
    contacts = problem.contacts._replace(B=np.asfortranarray(problem.contacts.B))
    a = solution_of(InverseDynamicsQP(N, GAMMA), problem._replace(rows=rows, contacts=contacts)).a
    np.testing.assert_array_equal(a, expected.a)


def test_wrong_shapes_are_refused():
    problem = random_problem(np.random.default_rng(7))
    rows, contacts = problem.rows, problem.contacts
    task = contacts.tasks[1]
    for bad in (
        {"rows": rows._replace(G=rows.G[:, 1:])},
        {"rows": rows._replace(lower=rows.lower[1:])},
        {"rows": rows._replace(upper=rows.upper[1:])},
        {"contacts": contacts._replace(B=contacts.B[1:])},
        {"contacts": contacts._replace(rho_max=contacts.rho_max[1:])},
        {"contacts": contacts._replace(tasks=[task._replace(W=task.W[:, 1:])])},
        {"contacts": contacts._replace(tasks=[task._replace(F_des=np.zeros(6))])},
    ):
        with pytest.raises(ValueError, match="joints with|wrench task of"):
            solution_of(InverseDynamicsQP(N, GAMMA), problem._replace(**bad))


@pytest.mark.parametrize("field", ["G", "lower", "upper", "B", "rho_max", "W", "F_des"])
def test_a_nan_raises_and_leaves_no_trace(field):
    problem = random_problem(np.random.default_rng(8))
    qp = InverseDynamicsQP(N, GAMMA)
    expected = solution_of(qp, problem).a
    rows, contacts = problem.rows, problem.contacts
    part = rows if field in rows._fields else contacts
    part = part if field in part._fields else contacts.tasks[0]
    poisoned = getattr(part, field).copy()
    poisoned.flat[1] = np.nan
    bad = part._replace(**{field: poisoned})
    if part is rows:
        bad = problem._replace(rows=bad)
    elif part is contacts:
        bad = problem._replace(contacts=bad)
    else:
        bad = problem._replace(contacts=contacts._replace(tasks=[bad]))
    with pytest.raises(NoSolutionFound):
        solution_of(qp, bad)
    np.testing.assert_allclose(solution_of(qp, problem).a, expected, atol=1e-6)


def test_crossed_rows_raise():
    problem = random_problem(np.random.default_rng(9))
    rows = problem.rows._replace(lower=np.full(10, 1.0), upper=np.zeros(10))
    with pytest.raises(NoSolutionFound):
        solution_of(InverseDynamicsQP(N, GAMMA), problem._replace(rows=rows))
