# SPDX-License-Identifier: Apache-2.0
"""The QP with one solver or another, or none that solves it."""

import numpy as np
import pytest
from qp_problems import GAMMA, LITTLE_ROOM, N, built, random_problem, solution_of
from scipy.optimize import Bounds, minimize

from torque_safety_controller.qp import (
    SOLVERS,
    DaqpSolver,
    InverseDynamicsQP,
    NoSolutionFound,
    ProxqpSolver,
    QuadraticProgram,
    SolverResult,
    Status,
)


def test_proxqp_gives_the_same_accelerations():
    rng = np.random.default_rng(30)
    mine, other = InverseDynamicsQP(N, GAMMA), InverseDynamicsQP(N, GAMMA, "proxqp")
    for _ in range(60):
        problem = random_problem(rng)
        expected, found = solution_of(mine, problem), solution_of(other, problem)
        assert (expected.relaxation is None) == (found.relaxation is None)
        np.testing.assert_allclose(found.a, expected.a, atol=1e-4)
    little = solution_of(other, LITTLE_ROOM)
    assert little.relaxation is None
    np.testing.assert_allclose(little.a, solution_of(mine, LITTLE_ROOM).a, atol=1e-4)


class Failing:
    """A solver that never solves anything."""

    def solve(self, program):
        return SolverResult(Status.FAILED, np.full(len(program.g), np.nan), 0)


def test_proxqp_is_asked_where_daqp_fails(monkeypatch):
    problem = random_problem(np.random.default_rng(31))
    expected = solution_of(InverseDynamicsQP(N, GAMMA), problem)
    monkeypatch.setitem(SOLVERS, "daqp", Failing)
    found = solution_of(InverseDynamicsQP(N, GAMMA), problem)
    np.testing.assert_allclose(found.a, expected.a, atol=1e-4)


def test_what_no_solver_solves_comes_with_the_error(monkeypatch):
    for name in SOLVERS:
        monkeypatch.setitem(SOLVERS, name, Failing)
    qp = InverseDynamicsQP(N, GAMMA)
    program = built(qp, random_problem(np.random.default_rng(33)))
    with pytest.raises(NoSolutionFound) as caught:
        qp.solve(program)
    assert caught.value.program is program


def test_proxqp_does_not_go_on_where_there_is_no_solution():
    problem = random_problem(np.random.default_rng(32))
    crossed = problem._replace(a_lower=problem.a_upper + 1.0)
    with pytest.raises(NoSolutionFound):
        solution_of(InverseDynamicsQP(N, GAMMA, "proxqp"), crossed)


def by_slsqp(program: QuadraticProgram) -> np.ndarray:
    """A third solver, of a third kind: sequential least squares, for problems in general."""
    n = len(program.g)
    below, above = np.isfinite(program.lower[n:]), np.isfinite(program.upper[n:])
    C, lower, upper = program.C, program.lower[n:], program.upper[n:]
    return minimize(
        program.cost,
        np.zeros(n),
        jac=lambda x: program.H @ x + program.g,
        bounds=Bounds(program.lower[:n], program.upper[:n]),
        constraints=[
            {"type": "ineq", "fun": lambda x: (C @ x - lower)[below], "jac": lambda _: C[below]},
            {"type": "ineq", "fun": lambda x: (upper - C @ x)[above], "jac": lambda _: -C[above]},
        ],
        method="SLSQP",
        options={"ftol": 1e-14, "maxiter": 1000},
    ).x


def test_any_solver_can_be_handed_the_program():
    rng = np.random.default_rng(34)
    qp = InverseDynamicsQP(N, GAMMA)
    for _ in range(20):
        program = built(qp, random_problem(rng))
        found = DaqpSolver().solve(program)
        if found.status is not Status.SOLVED:
            continue
        np.testing.assert_allclose(qp.solve(program).a, found.x, atol=1e-9)
        np.testing.assert_allclose(ProxqpSolver().solve(program).x, found.x, atol=1e-4)
        assert program.cost(found.x) <= program.cost(by_slsqp(program)) + 1e-6
