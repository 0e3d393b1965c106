# SPDX-License-Identifier: Apache-2.0
"""Where torque limits and bounds contradict each other, the bounds give way least."""

import numpy as np
import pytest
from qp_problems import (
    ACCELERATION_TOLERANCE,
    GAMMA,
    N,
    assert_cost_is_least,
    assert_torques_kept,
    excess,
    least_relaxation,
    random_problem,
    reference,
    solution_of,
)

from torque_safety_controller.qp import (
    InverseDynamicsQP,
    NoSolutionFound,
)


@pytest.mark.parametrize(("room", "scale"), [(0.3, 0.1), (0.3, 1.0), (0.05, 1.0), (0.3, 100.0)])
def test_when_both_cannot_be_met_torques_win_and_the_bounds_give_way_least(room, scale):
    rng = np.random.default_rng(5)
    qp = InverseDynamicsQP(N, GAMMA)
    relaxed = 0
    for _ in range(60):
        problem = random_problem(rng, room, scale)
        needed = least_relaxation(problem)
        if np.abs(needed).max() < 1e-2:
            continue
        relaxed += 1
        solution = solution_of(qp, problem)
        a, relaxation = solution.a, solution.relaxation
        assert_torques_kept(problem, a)
        np.testing.assert_allclose(relaxation, excess(problem, a), atol=1e-12)
        np.testing.assert_allclose(relaxation, np.abs(needed), atol=1e-4)
        assert np.linalg.norm(relaxation) <= np.linalg.norm(needed) + 1e-5
        # What freedom is left serves the tasks: best with the bounds moved by what is needed.
        best = reference(
            problem._replace(
                a_lower=problem.a_lower + np.minimum(needed, 0.0),
                a_upper=problem.a_upper + np.maximum(needed, 0.0),
            ),
            widen=1e-5,
        )
        assert best is not None
        assert_cost_is_least(problem, a, best)
    assert relaxed > 20


def test_one_problem_without_a_solution_leaves_no_trace():
    rng = np.random.default_rng(6)
    easy, hard = random_problem(rng), random_problem(rng, room=0.05)
    qp = InverseDynamicsQP(N, GAMMA)
    before = solution_of(qp, easy)
    assert before.relaxation is None
    assert solution_of(qp, hard).relaxation is not None
    after = solution_of(qp, easy)
    assert after.relaxation is None
    np.testing.assert_allclose(after.a, before.a, atol=ACCELERATION_TOLERANCE)


@pytest.mark.parametrize(
    ("ratio", "masses"), [(1e-4, 1.0), (1e4, 1.0), (1e-3, 1e3), (1e-3, 1e-3), (1.0, 1e-2)]
)
def test_the_least_relaxation_for_any_weights_and_masses(ratio, masses):
    rng = np.random.default_rng(36)
    qp = InverseDynamicsQP(N, GAMMA)
    relaxed = 0
    for k in range(100):
        problem = random_problem(rng, (0.3, 0.05)[k % 2])
        problem = problem._replace(
            tasks=[problem.tasks[0], problem.tasks[1]._replace(weight=3.0 * ratio)],
            M=masses * problem.M,
            tau_lower=masses * problem.tau_lower,
            tau_upper=masses * problem.tau_upper,
        )
        needed = least_relaxation(problem)
        solution = solution_of(qp, problem)
        assert_torques_kept(problem, solution.a)
        if np.abs(needed).max() > 1e-2:
            relaxed += 1
            np.testing.assert_allclose(solution.relaxation, np.abs(needed), atol=1e-4)
            assert np.linalg.norm(solution.relaxation) <= np.linalg.norm(needed) + 1e-5
    assert relaxed > 50


def test_relaxation_with_a_mass_matrix_that_none_has_fails():
    problem = random_problem(np.random.default_rng(38), 0.05)
    qp = InverseDynamicsQP(N, GAMMA)
    assert solution_of(qp, problem).relaxation is not None
    M = problem.M - 2.0 * np.linalg.eigvalsh(problem.M)[-1] * np.eye(N)
    with pytest.raises(NoSolutionFound, match="not positive definite"):
        solution_of(qp, problem._replace(M=M))
