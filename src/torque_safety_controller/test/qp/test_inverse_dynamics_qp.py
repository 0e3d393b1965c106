# SPDX-License-Identifier: Apache-2.0
"""The inverse-dynamics QP finds the least cost, and relaxes least where limits contradict."""

import numpy as np
import pytest
from qp_problems import (
    GAMMA,
    KEPT,
    N,
    assert_tasks_served_best,
    assert_torques_and_forces_kept,
    by_proxqp,
    least_relaxation,
    random_problem,
    solution_of,
)

from torque_safety_controller.qp import InverseDynamicsQP, LinearConstraints


@pytest.mark.parametrize(
    ("k", "r", "scale"), [(0, 0, 1.0), (0, 0, 100.0), (10, 8, 1.0), (20, 24, 1.0)]
)
def test_agrees_with_another_solver_on_another_form(k, r, scale):
    rng = np.random.default_rng(1)
    qp = InverseDynamicsQP(N, GAMMA)  # one solver, as in the loop: each starts from the last
    solved = limited = pushed = 0
    for _ in range(40):
        problem = random_problem(rng, k, r, scale=scale)
        solution = solution_of(qp, problem)
        assert solution.exact
        assert problem.excess(solution.a).max() < KEPT
        assert_torques_and_forces_kept(problem, solution)
        assert_tasks_served_best(problem, solution)
        S, lower, upper = problem.soft()
        limited += (np.minimum(S @ solution.a - lower, upper - S @ solution.a) < KEPT).any()
        pushed += (solution.rho > 1e-3).any()
        other = by_proxqp(problem)
        if other is not None:
            solved += 1
            x = np.r_[solution.a, solution.rho]
            np.testing.assert_allclose(x, other, atol=2e-2 if r else 1e-3)
    assert solved > 20
    assert limited > 12
    assert pushed > 12 or r == 0


@pytest.mark.parametrize(
    ("k", "r", "room", "scale", "masses"),
    [(0, 0, 0.3, 100.0, 1.0), (0, 0, 0.05, 1.0, 1e3), (10, 4, 0.3, 1.0, 1.0), (10, 4, 0.05, 1, 1)],
)
def test_torques_win_and_bounds_and_rows_give_way_by_the_least(k, r, room, scale, masses):
    rng = np.random.default_rng(2)
    qp = InverseDynamicsQP(N, GAMMA)
    relaxed = rows_relaxed = 0
    for _ in range(40):
        problem = random_problem(rng, k, r, room, scale, masses)
        needed = least_relaxation(problem)
        if needed.max() < 1e-2:
            continue
        relaxed += 1
        solution = solution_of(qp, problem)
        assert_torques_and_forces_kept(problem, solution)
        relaxation = np.r_[solution.relaxation, solution.constraint_relaxation]
        np.testing.assert_allclose(relaxation, problem.excess(solution.a), atol=1e-9)
        np.testing.assert_allclose(relaxation, needed, atol=1e-4)
        rows_relaxed += solution.constraint_relaxation.max(initial=0.0) > 1e-2
        # What freedom is left serves the tasks.
        assert_tasks_served_best(problem, solution)
    assert relaxed > 15
    assert rows_relaxed > 10 or k == 0


def test_a_dearer_row_gives_way_less():
    problem = random_problem(np.random.default_rng(3))
    wide, G = np.full(N, 1e6), np.zeros((1, N))
    G[0, 2] = 1.0
    upper = np.ones(N)
    for factor, expected in ((1.0, [0.5, 0.5]), (10.0, [100.0 / 101.0, 1.0 / 101.0])):
        row = LinearConstraints(factor * G, factor * np.array([2.0]), np.array([np.inf]))
        solution = solution_of(
            InverseDynamicsQP(N),
            problem._replace(
                rows=row, a_lower=-wide, a_upper=upper, tau_lower=-wide, tau_upper=wide
            ),
        )
        found = solution.relaxation[2], solution.constraint_relaxation[0] / factor
        np.testing.assert_allclose(found, expected, atol=1e-5)


@pytest.mark.parametrize("factor", [1e-4, 1e4])
def test_rows_of_any_usual_length_have_a_solution(factor):
    rng = np.random.default_rng(10)
    for _ in range(20):
        problem = random_problem(rng, 8, 4, 0.3)
        problem = problem._replace(rows=problem.rows._replace(G=factor * problem.rows.G))
        assert_torques_and_forces_kept(problem, solution_of(InverseDynamicsQP(N, GAMMA), problem))


def test_no_problem_leaves_a_trace_and_the_same_again_takes_one_iteration():
    """Sizes change from step to step, and some problems have no solution without relaxation."""
    rng = np.random.default_rng(4)
    qp = InverseDynamicsQP(N, GAMMA)
    exact = 0
    for _ in range(40):
        k, r = int(rng.integers(0, 12)), int(rng.integers(0, 3)) * 4
        problem = random_problem(rng, k, r, rng.choice([0.3, 1.0]))
        if rng.random() < 0.3:
            problem = problem._replace(rows=None)
        if rng.random() < 0.3:
            problem = problem._replace(contacts=None)
        used, fresh = solution_of(qp, problem), solution_of(InverseDynamicsQP(N, GAMMA), problem)
        np.testing.assert_allclose(used.a, fresh.a, atol=1e-5)
        np.testing.assert_allclose(used.rho, fresh.rho, atol=1e-4)
        assert used.exact == fresh.exact
        if used.exact:
            exact += 1
            assert solution_of(qp, problem).iterations == 1
    assert 10 < exact < 35


def test_wrong_shapes_are_refused():
    problem = random_problem(np.random.default_rng(7), 10, 8)
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
