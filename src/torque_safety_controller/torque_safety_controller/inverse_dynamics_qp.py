"""The QP for joint accelerations: eq. (33) of [DelPrete2018], eq. (5) of [Benallegue2021].

    minimise    sum_t w_t |A_t a - b_t|^2 + gamma |a|^2
    subject to  a_lower <= a <= a_upper,   tau_min <= M a + h <= tau_max.

Torques are eliminated by the dynamics, so that n accelerations are the only variables. The
torque rows always have a solution, as M is regular; together with the acceleration bounds they
may not. Then the torque rows win and the bounds give way as little as possible, in the sense
of least squares.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from proxsuite import proxqp

from torque_safety_controller.tasks import TaskTerm

_TOLERANCE = 1e-8
_WARM_ITERATIONS = 100
_COLD_ITERATIONS = 2000
# Leaves the relaxed box an interior, without which ProxQP converges slowly.
_SLACK = 1e-6


class Solution(NamedTuple):
    """What the QP returned."""

    a: np.ndarray
    """Accelerations, shape (n,), rad/s^2."""
    relaxation: np.ndarray | None
    """By how much bounds gave way, shape (n,), rad/s^2; None when none had to."""
    iterations: int


class NoSolutionFound(RuntimeError):
    """The solver did not converge, or was given values that are not finite."""


class InverseDynamicsQP:
    """Assembles and solves the QP, starting from the last solution.

    Args:
        n: number of joints.
        gamma: weight of |a|^2, relative to the largest task weight; keeps the solution unique.
    """

    def __init__(self, n: int, gamma: float = 1e-6) -> None:
        self._n = n
        self._gamma = gamma
        self._H = np.zeros((n, n))
        self._g = np.zeros(n)
        self._diagonal = np.einsum("ii->i", self._H)
        self._qp: proxqp.dense.QP | None = None
        self._relaxed: proxqp.dense.QP | None = None

    def solve(
        self,
        tasks: Sequence[TaskTerm],
        a_lower: np.ndarray,
        a_upper: np.ndarray,
        M: np.ndarray,
        tau_lower: np.ndarray,
        tau_upper: np.ndarray,
    ) -> Solution:
        """Return the accelerations that serve the tasks best within the limits.

        Args:
            tasks: at least one.
            a_lower: shape (n,), rad/s^2.
            a_upper: shape (n,), rad/s^2, not below `a_lower`.
            M: mass matrix, shape (n, n).
            tau_lower: lower limits of M a, bias torque subtracted, shape (n,), N m.
            tau_upper: upper limits of M a, shape (n,), N m.

        Raises:
            NoSolutionFound: no solution, or numbers that are not finite.
        """
        self._assemble(tasks)
        a, iterations = self._solve_main(M, tau_lower, tau_upper, a_lower, a_upper)
        if a is not None:
            return Solution(a, None, iterations)
        nearest = self._nearest_feasible(M, tau_lower, tau_upper, a_lower, a_upper)
        relaxation = np.maximum(a_lower - nearest, nearest - a_upper).clip(0.0)
        lower = np.minimum(a_lower, nearest - _SLACK)
        upper = np.maximum(a_upper, nearest + _SLACK)
        self._qp = None
        a, more = self._solve_main(M, tau_lower, tau_upper, lower, upper)
        # The nearest point keeps the limits as well as they can be; only the tasks suffer.
        return Solution(nearest if a is None else a, relaxation, iterations + more)

    def _assemble(self, tasks: Sequence[TaskTerm]) -> None:
        """Fill H and g; the largest weight becomes 1, so that the tolerance keeps its sense."""
        scale = 1.0 / max(task.weight for task in tasks)
        self._H.fill(0.0)
        self._g.fill(0.0)
        self._diagonal += self._gamma
        for A, b, weight in tasks:
            w = weight * scale
            if A is None:
                self._diagonal += w
                self._g -= w * b
            else:
                wA = w * A
                self._H += wA.T @ A
                self._g -= b @ wA

    def _solve_main(self, M, tau_lower, tau_upper, a_lower, a_upper):
        n = self._n
        problem = (self._H, self._g, None, None, M, tau_lower, tau_upper, a_lower, a_upper)
        if self._qp is None:
            self._qp = proxqp.dense.QP(n, 0, n, True)
            _configure(self._qp, _COLD_ITERATIONS)
            self._qp.init(*problem)
        else:
            self._qp.settings.max_iter = _WARM_ITERATIONS
            self._qp.update(*problem, False)
        return _result(self._qp, n)

    def _nearest_feasible(self, M, tau_lower, tau_upper, a_lower, a_upper) -> np.ndarray:
        """Return the accelerations within the torque rows that are nearest to the box.

        In the variables (a, e): minimise |e|^2 with a - e in the box and M a in the torque
        rows, plus a term of 1e-8 |a|^2 that picks one where there are many.
        """
        n = self._n
        H = np.diag(np.r_[np.full(n, 1e-8), np.ones(n)])
        eye = np.eye(n)
        C = np.block([[M, np.zeros((n, n))], [eye, -eye]])
        lower, upper = np.r_[tau_lower, a_lower], np.r_[tau_upper, a_upper]
        problem = (H, np.zeros(2 * n), None, None, C, lower, upper)
        qp = proxqp.dense.QP(2 * n, 0, 2 * n)
        _configure(qp, _COLD_ITERATIONS)
        qp.init(*problem)
        solution, _ = _result(qp, 2 * n)
        if solution is None:
            raise NoSolutionFound("no accelerations within the torque limits were found")
        return solution[:n]


def _configure(qp: proxqp.dense.QP, max_iterations: int) -> None:
    qp.settings.eps_abs = _TOLERANCE
    qp.settings.eps_rel = 0.0
    qp.settings.max_iter = max_iterations
    qp.settings.initial_guess = proxqp.InitialGuess.WARM_START_WITH_PREVIOUS_RESULT


def _result(qp: proxqp.dense.QP, n: int) -> tuple[np.ndarray | None, int]:
    qp.solve()
    iterations = qp.results.info.iter
    if qp.results.info.status != proxqp.QPSolverOutput.PROXQP_SOLVED:
        return None, iterations
    x = np.array(qp.results.x[:n])
    return (x if np.isfinite(x).all() else None), iterations
