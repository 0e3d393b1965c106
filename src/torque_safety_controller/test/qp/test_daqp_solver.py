# SPDX-License-Identifier: Apache-2.0
"""DAQP as it is used here: optimal, certain of infeasibility, and not misled by its past."""

import numpy as np
import pytest
from scipy.optimize import linprog, nnls

from torque_safety_controller.qp import DaqpSolver, QuadraticProgram, Status

SAME = 1e-6  # of solutions that only rounding keeps apart


def random_problem(rng, n, m, tight=1.0, flat=1e-3, inside=True) -> QuadraticProgram:
    """Some limits infinite, some equal; with `inside` there is a point that keeps them all."""
    A = rng.normal(size=(max(1, n // 2), n))
    C = rng.normal(size=(m, n)) * 10.0 ** rng.uniform(-1, 1, (m, 1))
    if m > 5:
        C[3] = 2.0 * C[2]  # parallel, so that the two are active together or contradict
        C[4] = np.eye(n)[0]  # as the limits of x itself
        C[5] = 0.0
    x = rng.normal(size=n)
    middle = np.r_[x, C @ x] if inside else rng.normal(size=n + m)
    lower, upper = (middle + s * tight * rng.uniform(0.0, 2.0, n + m) for s in (-1.0, 1.0))
    kind = rng.random(n + m)
    lower[kind < 0.2] = -np.inf
    upper[(kind > 0.1) & (kind < 0.3)] = np.inf
    equal = kind > 0.95
    lower[equal] = upper[equal] = middle[equal]
    return QuadraticProgram(A.T @ A + flat * np.eye(n), 10.0 * rng.normal(size=n), C, lower, upper)


def rows(problem):
    return np.vstack([np.eye(len(problem.g)), problem.C])


def solve(problem, solver=None):
    result = (solver or DaqpSolver()).solve(problem)
    return result.status, result.x


def assert_optimal(problem, x):
    """Karush-Kuhn-Tucker: limits kept, and multipliers of the right sign balance the slope."""
    assert problem.violations(x).max() < 1e-7
    value, N = rows(problem) @ x, rows(problem)
    at_lower, at_upper = (np.abs(value - each) < 1e-7 for each in (problem.lower, problem.upper))
    slope = problem.H @ x + problem.g
    normals = np.vstack([N[at_lower], -N[at_upper]])
    left = nnls(normals.T, slope)[1] if len(normals) else np.linalg.norm(slope)
    assert left < 1e-7 * (1.0 + np.linalg.norm(problem.g))


def has_a_point(problem) -> bool:
    N = rows(problem)
    A, b = np.vstack([N, -N]), np.r_[problem.upper, -problem.lower]
    finite = np.isfinite(b)
    found = linprog(np.zeros(N.shape[1]), A[finite], b[finite], bounds=(None, None))
    return found.status == 0


@pytest.mark.parametrize("flat", [1e-3, 1e-6, 1e-9])
@pytest.mark.parametrize(("n", "m"), [(1, 0), (1, 1), (9, 19), (25, 40)])
def test_is_optimal_whatever_was_solved_before(n, m, flat):
    """And the same again takes one iteration."""
    rng = np.random.default_rng(2)
    solver = DaqpSolver()  # one, as in a control loop: each begins with what was active last
    for _ in range(15):
        problem = random_problem(rng, n, m, flat=flat)
        status, x = solve(problem, solver)
        assert status is Status.SOLVED
        assert_optimal(problem, x)
        np.testing.assert_allclose(x, solve(problem)[1], atol=SAME)
        assert solver.solve(problem).iterations == 1 or flat == 1e-9
        if rng.random() < 0.2:  # something that cannot be solved, in between
            crossed = problem._replace(lower=problem.upper + 1.0)
            assert solve(crossed, solver)[0] is Status.FAILED


def test_knows_whether_there_is_a_solution():
    rng = np.random.default_rng(3)
    solver = DaqpSolver()
    known = {True: 0, False: 0}
    for _ in range(60):
        n, m = rng.integers(2, 10), rng.integers(1, 15)
        problem = random_problem(rng, n, m, rng.uniform(0.1, 2.0), inside=False)
        exists = has_a_point(problem)
        known[exists] += 1
        for status, x in (solve(problem), solve(problem, solver)):
            assert (status is Status.INFEASIBLE) == (not exists)
            if exists:
                assert_optimal(problem, x)
    assert min(known.values()) > 5


def test_rows_that_contradict_each_other_through_others_have_no_solution():
    """One row is a combination of the others but for rounding, and its limit is not."""
    rng = np.random.default_rng(9)
    for _ in range(30):
        n, m = 12, 4
        problem = random_problem(rng, n, 0)
        C, b = rng.normal(size=(m, n)), rng.normal(size=m)
        share = rng.uniform(0.1, 1.0, m)
        C, b = np.vstack([C, share @ C / 3.0]), np.r_[b, share @ b / 3.0 - 1e-3]
        no, some = np.full(n, np.inf), np.full(m, np.inf)
        lower, upper = np.r_[-no, b[:m], -np.inf], np.r_[no, some, b[m]]
        assert solve(problem._replace(C=C, lower=lower, upper=upper))[0] is Status.INFEASIBLE
    zero = np.zeros((1, 12))
    lower, upper = np.r_[np.full(12, -9.0), 1.0], np.full(13, 9.0)
    assert solve(problem._replace(C=zero, lower=lower, upper=upper))[0] is Status.INFEASIBLE


@pytest.mark.parametrize("field", ["H", "g", "C", "lower", "upper"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_what_is_not_finite_fails_or_is_no_limit(field, value):
    problem = random_problem(np.random.default_rng(7), 5, 3)
    allowed = (field, value) in {("lower", -np.inf), ("upper", np.inf)}
    for place in (0, -1):
        bad = getattr(problem, field).copy()
        bad.flat[place] = value
        warm = DaqpSolver()
        solve(problem, warm)
        for solver in (DaqpSolver(), warm):
            status, x = solve(problem._replace(**{field: bad}), solver)
            assert status is (Status.SOLVED if allowed else Status.FAILED)
            assert not allowed or np.isfinite(x).all()


def test_crossed_limits_and_costs_without_a_minimum_fail():
    problem = random_problem(np.random.default_rng(8), 5, 3)
    assert solve(problem._replace(lower=problem.upper + 1.0))[0] is Status.FAILED
    assert solve(problem._replace(H=-problem.H))[0] is Status.FAILED
    assert solve(problem._replace(H=0.0 * problem.H))[0] is Status.FAILED


def test_cost_and_violations_of_a_solution():
    problem = QuadraticProgram(
        np.eye(2),
        np.array([-4.0, 1.0]),
        np.ones((1, 2)),
        np.array([-np.inf, 0.5, -np.inf]),
        np.array([np.inf, np.inf, 2.0]),
    )
    _, x = solve(problem)
    np.testing.assert_allclose(x, [1.5, 0.5])
    np.testing.assert_allclose(problem.violations(x + 1.0), [0.0, 0.0, 2.0])
    assert problem.cost(x) == pytest.approx(-4.25)
