# SPDX-License-Identifier: Apache-2.0
"""Numbers that are no problem, or hardly one: refused without a trace; and solvers that fail."""

import numpy as np
import pytest
from qp_problems import (
    GAMMA,
    N,
    assert_torques_and_forces_kept,
    random_problem,
    solution_of,
)

from torque_safety_controller.qp import (
    SOLVERS,
    InverseDynamicsQP,
    NoSolutionFound,
    SolverResult,
    Status,
)


def test_a_nan_raises_and_leaves_no_trace():
    problem = random_problem(np.random.default_rng(8), 10, 8)
    task, wrench, qp = problem.tasks[0], problem.contacts.tasks[0], InverseDynamicsQP(N, GAMMA)
    expected = solution_of(qp, problem).a
    for array in (
        *(task.A, task.b, wrench.W, wrench.F_des),
        *(problem.a_lower, problem.a_upper, problem.M, problem.tau_lower, problem.tau_upper),
        *problem.rows,
        *(problem.contacts.B, problem.contacts.rho_max),
    ):
        good, array.flat[1] = array.flat[1], np.nan
        with pytest.raises(NoSolutionFound):
            solution_of(qp, problem)
        array.flat[1] = good
        np.testing.assert_allclose(solution_of(qp, problem).a, expected, atol=1e-6)


@pytest.mark.parametrize("solver", SOLVERS)
def test_crossed_limits_raise(solver):
    problem = random_problem(np.random.default_rng(9), 10)
    rows = problem.rows._replace(lower=np.full(10, 1.0), upper=np.zeros(10))
    for crossed in (
        {"a_lower": problem.a_upper + 1.0},
        {"tau_lower": problem.tau_upper + 1.0},
        {"rows": rows},
    ):
        with pytest.raises(NoSolutionFound):
            solution_of(InverseDynamicsQP(N, GAMMA, solver), problem._replace(**crossed))


def test_without_a_weight_there_is_no_solution():
    problem = random_problem(np.random.default_rng(13))
    for weight in (0.0, np.nan):
        tasks = [task._replace(weight=weight) for task in problem.tasks]
        with pytest.raises(NoSolutionFound):
            solution_of(InverseDynamicsQP(N, GAMMA), problem._replace(tasks=tasks))


@pytest.mark.parametrize("scale", [1e12, 1e100, 1e306])
def test_absurd_numbers_break_no_torque_limits(scale):
    rng = np.random.default_rng(11)
    qp = InverseDynamicsQP(N, GAMMA)
    for room in (1.0, 0.3, 0.05):
        problem = random_problem(rng, room=room, scale=scale)
        try:
            solution = solution_of(qp, problem)
        except NoSolutionFound:
            continue
        assert np.isfinite(solution.a).all()
        assert_torques_and_forces_kept(problem, solution)


def test_a_mass_matrix_that_is_nearly_singular_or_none():
    rng = np.random.default_rng(37)
    qp = InverseDynamicsQP(N, GAMMA)
    for k in range(20):
        problem = random_problem(rng, room=(1.0, 0.3)[k % 2])
        u = rng.normal(size=(N, 1))
        problem = problem._replace(M=u @ u.T + 10.0 ** rng.uniform(-6, -2) * np.eye(N))
        assert_torques_and_forces_kept(problem, solution_of(qp, problem))
    problem = random_problem(rng, room=0.05)
    assert not solution_of(qp, problem).exact
    M = problem.M - 2.0 * np.linalg.eigvalsh(problem.M)[-1] * np.eye(N)
    with pytest.raises(NoSolutionFound, match="not positive definite"):
        solution_of(qp, problem._replace(M=M))


# Solvers


def test_proxqp_gives_the_same_accelerations():
    rng = np.random.default_rng(30)
    mine, other = InverseDynamicsQP(N, GAMMA), InverseDynamicsQP(N, GAMMA, "proxqp")
    for k in range(20):
        problem = random_problem(rng, 4, 4, room=(1.0, 0.3)[k % 2])
        expected, found = solution_of(mine, problem), solution_of(other, problem)
        assert expected.exact == found.exact
        np.testing.assert_allclose(found.a, expected.a, atol=1e-4)


class Failing:
    """A solver that never solves anything."""

    def solve(self, program):
        return SolverResult(Status.FAILED, np.full(len(program.g), np.nan), 0)


def test_proxqp_is_asked_where_daqp_fails_and_if_all_fail_the_error_has_the_program(monkeypatch):
    problem = random_problem(np.random.default_rng(31))
    expected = solution_of(InverseDynamicsQP(N, GAMMA), problem)
    monkeypatch.setitem(SOLVERS, "daqp", Failing)
    found = solution_of(InverseDynamicsQP(N, GAMMA), problem)
    np.testing.assert_allclose(found.a, expected.a, atol=1e-4)
    monkeypatch.setitem(SOLVERS, "proxqp", Failing)
    qp = InverseDynamicsQP(N, GAMMA)
    with pytest.raises(NoSolutionFound) as caught:
        solution_of(qp, problem)
    np.testing.assert_array_equal(caught.value.program.C[:N, :N], problem.M)
