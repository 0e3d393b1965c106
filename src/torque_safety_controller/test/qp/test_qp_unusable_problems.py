# SPDX-License-Identifier: Apache-2.0
"""Numbers that are no problem, or hardly one: soon refused, and without a trace."""

import time

import numpy as np
import pytest
from qp_problems import (
    ACCELERATION_TOLERANCE,
    GAMMA,
    LONG,
    N,
    assert_torques_kept,
    random_problem,
    solution_of,
)

from torque_safety_controller.qp import (
    InverseDynamicsQP,
    NoSolutionFound,
)


def test_without_a_weight_there_is_no_solution():
    problem = random_problem(np.random.default_rng(13))
    for weight in (0.0, np.nan):
        tasks = [task._replace(weight=weight) for task in problem.tasks]
        with pytest.raises(NoSolutionFound):
            solution_of(InverseDynamicsQP(N, GAMMA), problem._replace(tasks=tasks))


@pytest.mark.parametrize("field", ["A", "b", "a_lower", "a_upper", "M", "tau_lower", "tau_upper"])
@pytest.mark.parametrize("warm", [False, True])
def test_a_nan_raises_soon_and_leaves_no_trace(field, warm):
    problem = random_problem(np.random.default_rng(9))
    expected = solution_of(InverseDynamicsQP(N, GAMMA), problem).a
    qp = InverseDynamicsQP(N, GAMMA)
    if warm:
        solution_of(qp, problem)
    if field in ("A", "b"):
        poisoned = getattr(problem.tasks[0], field).copy()
        bad = problem._replace(
            tasks=[problem.tasks[0]._replace(**{field: poisoned}), problem.tasks[1]]
        )
    else:
        poisoned = getattr(problem, field).copy()
        bad = problem._replace(**{field: poisoned})
    poisoned.flat[3] = np.nan
    begin = time.monotonic()
    with pytest.raises(NoSolutionFound):
        solution_of(qp, bad)
    assert time.monotonic() - begin < LONG
    solution = solution_of(qp, problem)
    assert solution.relaxation is None
    np.testing.assert_allclose(solution.a, expected, atol=ACCELERATION_TOLERANCE)


@pytest.mark.parametrize(("low", "high"), [("a_lower", "a_upper"), ("tau_lower", "tau_upper")])
def test_crossed_limits_raise_soon(low, high):
    problem = random_problem(np.random.default_rng(10))
    crossed = problem._replace(**{low: getattr(problem, high) + 1.0})
    begin = time.monotonic()
    with pytest.raises(NoSolutionFound):
        solution_of(InverseDynamicsQP(N, GAMMA), crossed)
    assert time.monotonic() - begin < LONG


@pytest.mark.parametrize("scale", [1e6, 1e12, 1e30, 1e100, 1e200, 1e307])
def test_absurd_numbers_cost_neither_time_nor_limits(scale):
    rng = np.random.default_rng(11)
    qp = InverseDynamicsQP(N, GAMMA)
    for room in (1.0, 0.3, 0.05):
        problem = random_problem(rng, room, scale)
        begin = time.monotonic()
        try:
            a = solution_of(qp, problem).a
        except NoSolutionFound:
            pass
        else:
            assert np.isfinite(a).all()
            assert_torques_kept(problem, a)
        assert time.monotonic() - begin < LONG


def test_a_mass_matrix_that_is_nearly_singular():
    rng = np.random.default_rng(37)
    qp = InverseDynamicsQP(N, GAMMA)
    for k in range(60):
        problem = random_problem(rng, (1.0, 0.3)[k % 2])
        u = rng.normal(size=(N, 1))
        problem = problem._replace(M=u @ u.T + 10.0 ** rng.uniform(-6, -2) * np.eye(N))
        assert_torques_kept(problem, solution_of(qp, problem).a)
