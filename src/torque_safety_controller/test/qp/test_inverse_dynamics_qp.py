# SPDX-License-Identifier: Apache-2.0
"""The inverse-dynamics QP finds the least cost within its limits."""

import numpy as np
import pytest
from qp_problems import (
    ACCELERATION_TOLERANCE,
    GAMMA,
    LITTLE_ROOM,
    NEAR,
    N,
    assert_cost_is_least,
    assert_torques_kept,
    built,
    excess,
    random_problem,
    reference,
    solution_of,
)

from torque_safety_controller.qp import InverseDynamicsQP


@pytest.mark.parametrize(("room", "scale"), [(1.0, 0.1), (1.0, 1.0), (1.0, 100.0), (0.6, 1.0)])
def test_agrees_with_an_independent_solver(room, scale):
    rng = np.random.default_rng(3)
    qp = InverseDynamicsQP(N, GAMMA)  # one solver, as in the loop: each starts from the last
    solved = limited = 0
    for _ in range(150):
        problem = random_problem(rng, room, scale)
        best = reference(problem)
        if best is None or reference(problem, -1e-4) is None:
            continue  # no solution, or one by a hair
        solved += 1
        solution = solution_of(qp, problem)
        a, relaxation = solution.a, solution.relaxation
        assert relaxation is None
        np.testing.assert_array_less(excess(problem, a), ACCELERATION_TOLERANCE)
        assert_torques_kept(problem, a)
        assert_cost_is_least(problem, a, best)
        np.testing.assert_allclose(a, best, rtol=1e-3, atol=NEAR)
        limited += np.isclose(a, problem.a_lower, atol=1e-3).any()
    assert solved > 40
    assert limited > 0.3 * solved or scale < 1.0, "the limits are hardly felt"


def test_without_limits_it_is_least_squares():
    rng = np.random.default_rng(4)
    problem = random_problem(rng)
    no = np.full(N, np.inf)
    unlimited = problem._replace(a_lower=-no, a_upper=no, tau_lower=-no, tau_upper=no)
    solution = solution_of(InverseDynamicsQP(N, GAMMA), unlimited)
    H, g = problem.cost()
    assert solution.relaxation is None
    np.testing.assert_allclose(solution.a, np.linalg.solve(H, -g), atol=1e-3)


def test_a_step_like_the_last_needs_one_iteration():
    rng = np.random.default_rng(12)
    qp = InverseDynamicsQP(N, GAMMA)
    no = np.full(N, np.inf)
    spared = limited = 0
    for _ in range(20):
        problem = random_problem(rng)._replace(tau_lower=-no, tau_upper=no)
        first = solution_of(qp, problem)
        again = solution_of(qp, problem)
        np.testing.assert_allclose(again.a, first.a, rtol=1e-5, atol=ACCELERATION_TOLERANCE)
        spared += again.iterations == 1
        limited += (excess(problem, 1.001 * first.a) > 0.0).any()
    assert limited == 20, "no bound is active"
    assert spared > 15


def test_little_room_is_not_taken_for_none():
    solution = solution_of(InverseDynamicsQP(N, GAMMA), LITTLE_ROOM)
    a, relaxation = solution.a, solution.relaxation
    assert relaxation is None
    np.testing.assert_allclose(a, reference(LITTLE_ROOM), atol=NEAR)


def test_a_joint_without_freedom():
    """Bounds that leave one acceleration, as for a joint that must brake with all it has."""
    problem = random_problem(np.random.default_rng(7))
    a_upper = problem.a_upper.copy()
    a_upper[2] = problem.a_lower[2]
    solution = solution_of(InverseDynamicsQP(N, GAMMA), problem._replace(a_upper=a_upper))
    a, relaxation = solution.a, solution.relaxation
    assert relaxation is None
    assert a[2] == pytest.approx(problem.a_lower[2], abs=ACCELERATION_TOLERANCE)


def test_only_the_ratio_of_weights_counts():
    problem = random_problem(np.random.default_rng(8))
    heavier = [task._replace(weight=1e5 * task.weight) for task in problem.tasks]
    a = solution_of(InverseDynamicsQP(N, GAMMA), problem).a
    b = solution_of(InverseDynamicsQP(N, GAMMA), problem._replace(tasks=heavier)).a
    np.testing.assert_allclose(a, b, atol=ACCELERATION_TOLERANCE)
    lighter = [problem.tasks[0], problem.tasks[1]._replace(weight=3.0)]
    c = solution_of(InverseDynamicsQP(N, GAMMA), problem._replace(tasks=lighter)).a
    assert np.abs(a - c).max() > 0.1


def test_the_program_is_what_was_asked_for():
    qp = InverseDynamicsQP(N, GAMMA)
    problem = random_problem(np.random.default_rng(35))
    program = built(qp, problem._replace(a_lower=np.full(N, 1.0), a_upper=np.full(N, 1.5)))
    np.testing.assert_array_equal(program.C, problem.M)
    np.testing.assert_array_equal(program.lower, np.r_[np.ones(N), problem.tau_lower])
    H, g = problem.cost()
    np.testing.assert_allclose(program.H, H, atol=1e-12)
    np.testing.assert_allclose(program.g, g, atol=1e-12)
