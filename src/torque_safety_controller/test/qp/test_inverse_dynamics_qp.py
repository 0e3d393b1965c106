# SPDX-License-Identifier: Apache-2.0
import time
from typing import NamedTuple

import numpy as np
import pytest
from scipy.linalg import cholesky, solve_triangular
from scipy.optimize import Bounds, lsq_linear, minimize, nnls

from torque_safety_controller.qp.constraints import AccelerationRange
from torque_safety_controller.qp.daqp_solver import DaqpSolver
from torque_safety_controller.qp.inverse_dynamics_qp import SOLVERS, InverseDynamicsQP
from torque_safety_controller.qp.proxqp_solver import ProxqpSolver
from torque_safety_controller.qp.quadratic_program import (
    NoSolutionFound,
    QuadraticProgram,
    SolverResult,
    Status,
)
from torque_safety_controller.qp.terms import TaskTerm

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


def test_the_program_says_what_it_limits():
    qp = InverseDynamicsQP(N, GAMMA)
    problem = random_problem(np.random.default_rng(35))
    program = built(qp, problem._replace(a_lower=np.full(N, 1.0), a_upper=np.full(N, 1.5)))
    assert program.names == tuple(
        f"{what} {i}" for what in ("acceleration", "torque") for i in range(N)
    )
    np.testing.assert_array_equal(program.C, problem.M)
    np.testing.assert_array_equal(program.lower, np.r_[np.ones(N), problem.tau_lower])
    H, g = problem.cost()
    np.testing.assert_allclose(program.H, H, atol=1e-12)
    np.testing.assert_allclose(program.g, g, atol=1e-12)
    a = np.full(N, 1.25)
    a[3] = 1.0
    assert "acceleration 3 min" in program.active(a)
    assert "acceleration 2 min" not in program.active(a)


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


def test_a_mass_matrix_that_is_nearly_singular():
    rng = np.random.default_rng(37)
    qp = InverseDynamicsQP(N, GAMMA)
    for k in range(60):
        problem = random_problem(rng, (1.0, 0.3)[k % 2])
        u = rng.normal(size=(N, 1))
        problem = problem._replace(M=u @ u.T + 10.0 ** rng.uniform(-6, -2) * np.eye(N))
        assert_torques_kept(problem, solution_of(qp, problem).a)


def test_relaxation_with_a_mass_matrix_that_none_has_fails():
    problem = random_problem(np.random.default_rng(38), 0.05)
    qp = InverseDynamicsQP(N, GAMMA)
    assert solution_of(qp, problem).relaxation is not None
    M = problem.M - 2.0 * np.linalg.eigvalsh(problem.M)[-1] * np.eye(N)
    with pytest.raises(NoSolutionFound, match="not positive definite"):
        solution_of(qp, problem._replace(M=M))
