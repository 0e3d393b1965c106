"""The QP for joint accelerations: eq. (33) of [DelPrete2018], eq. (5) of [Benallegue2021].

    minimise    sum_t w_t |A_t a - b_t|^2 + gamma |a|^2
    subject to  a_lower <= a <= a_upper,   tau_min <= M a + h <= tau_max.

Torques are eliminated by the dynamics, so that n accelerations are the only variables. The
torque rows always have a solution, as M is regular; together with the acceleration bounds they
may not. Then the torque rows win and the bounds give way as little as possible, in the sense
of least squares.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from proxsuite import proxqp

from torque_safety_controller.dense_kernels import (
    add_identity,
    add_rows,
    minimum_with_bounds_active,
)
from torque_safety_controller.tasks import TaskTerm

_TOLERANCE = 1e-8  # rad/s^2 and N m at most
# Solvable problems take up to 11 outer and 50 inner iterations. ProxQP's own limits let one
# without a solution go on for 15 s.
_OUTER_ITERATIONS = 25
_INNER_ITERATIONS = 50
# With ProxQP's own 1e-4, problems with little room are taken for ones without a solution.
_INFEASIBILITY_TOLERANCE = 1e-8
# What giving way costs, relative to the tasks' gradient: the bounds give way by up to 5e-5
# rad/s^2 more than they must, and the solver still tells good accelerations from bad ones.
_PENALTY = 1e5
_RELAXED_TOLERANCE = 1e-10
# How near to a bound a solution of the solver counts as being at it, rad/s^2.
_AT_BOUND = 1e-4
_KEPT = 1e-6  # rad/s^2 and N m
# Less relaxation than this, rad/s^2, is none: one problem in a thousand that has a solution is
# taken for one that has not.
_NEGLIGIBLE = 1e-4


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
    """Assembles and solves the QP; the bounds active in the last solution are tried first.

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
        self._side = np.zeros(n)  # of the bound that is active: 1 lower, -1 upper, 0 none

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
        # Mostly the bounds that were active in the last step still are, and no others: then the
        # solution takes a tenth of what the solver needs.
        a = np.empty(self._n)
        if minimum_with_bounds_active(
            self._H, self._g, self._side, a_lower, a_upper, M, tau_lower, tau_upper, a
        ):
            return Solution(a, None, 0)
        if not self._is_usable(M, tau_lower, tau_upper, a_lower, a_upper):
            raise NoSolutionFound("not finite, or lower limits above upper ones")
        a, iterations = self._solve_main(M, tau_lower, tau_upper, a_lower, a_upper)
        if a is not None:
            np.clip(a, a_lower, a_upper, out=a)  # off by the solver's tolerance at most
            self._note_active_bounds(a, a_lower, a_upper)
            return Solution(a, None, iterations)
        self._qp = None  # what it scales problems by was found for one with a solution
        a, more = self._solve_relaxed(M, tau_lower, tau_upper, a_lower, a_upper)
        relaxation = np.maximum(a_lower - a, a - a_upper).clip(0.0)
        if relaxation.max() < _NEGLIGIBLE:
            relaxation = None
        return Solution(a, relaxation, iterations + more)

    def _is_usable(self, M, tau_lower, tau_upper, a_lower, a_upper) -> bool:
        """Return whether the problem is finite; limits may be infinite, but not crossed.

        ProxQP takes a NaN in the limits for no limit, and searches long for one elsewhere.
        """
        total = self._g.dot(self._g) + self._H.sum() + M.sum()
        return math.isfinite(total) and bool(
            ((tau_lower <= tau_upper) & (a_lower <= a_upper)).all()
        )

    def _assemble(self, tasks: Sequence[TaskTerm]) -> None:
        """Fill H and g; the largest weight becomes 1, so that the tolerance keeps its sense."""
        scale = 1.0 / max(task.weight for task in tasks)
        H, g = self._H, self._g
        H.fill(0.0)
        g.fill(0.0)
        self._diagonal += self._gamma
        for A, b, weight in tasks:
            if A is None:
                add_identity(H, g, b, weight * scale)
            else:
                add_rows(H, g, A, b, weight * scale)

    def _note_active_bounds(self, a: np.ndarray, a_lower: np.ndarray, a_upper: np.ndarray) -> None:
        """Keep which accelerations of a solution are at a bound, and at which."""
        gradient = self._H @ a + self._g
        at_lower = (a <= a_lower + _AT_BOUND) & (gradient > 0.0)
        at_upper = (a >= a_upper - _AT_BOUND) & (gradient < 0.0)
        self._side = at_lower.astype(float) - at_upper

    def _solve_main(self, M, tau_lower, tau_upper, a_lower, a_upper):
        problem = (self._H, self._g, None, None, M, tau_lower, tau_upper, a_lower, a_upper)
        if self._qp is None:
            self._qp = proxqp.dense.QP(self._n, 0, self._n, True)
            _configure(self._qp, _TOLERANCE)
            # Without it, ProxQP can stop up to 0.01 rad/s^2 short of a limit it should be at.
            self._qp.settings.check_duality_gap = True
            self._qp.settings.eps_duality_gap_abs = _TOLERANCE
            self._qp.settings.eps_duality_gap_rel = _TOLERANCE
            self._qp.init(*problem)
        else:
            self._qp.update(*problem, False)
        return _result(self._qp, self._n)

    def _solve_relaxed(self, M, tau_lower, tau_upper, a_lower, a_upper) -> tuple[np.ndarray, int]:
        """Return accelerations within the torque rows, as near to the box as they can be.

        In the variables (a, e), where e is by how much a is outside the box:

            minimise |e|^2 + cost(a) / penalty   subject to   a - e in the box, M a in its rows.
        """
        n = self._n
        penalty = _PENALTY * max(1.0, float(np.abs(self._g).max()))
        H = np.zeros((2 * n, 2 * n))
        H[:n, :n] = self._H / penalty
        eye = H[n:, n:] = np.eye(n)
        C = np.block([[M, np.zeros((n, n))], [eye, -eye]])
        lower, upper = np.r_[tau_lower, a_lower], np.r_[tau_upper, a_upper]
        qp = proxqp.dense.QP(2 * n, 0, 2 * n)
        _configure(qp, _RELAXED_TOLERANCE)
        qp.init(H, np.r_[self._g / penalty, np.zeros(n)], None, None, C, lower, upper)
        qp.solve()
        a = np.array(qp.results.x[:n])
        # What keeps the rows will do, converged or not: all else is a matter of the tasks.
        if not (np.isfinite(a).all() and qp.results.info.pri_res < _KEPT):
            raise NoSolutionFound("no accelerations within the torque limits were found")
        return a, qp.results.info.iter


def _configure(qp: proxqp.dense.QP, tolerance: float) -> None:
    qp.settings.eps_abs = tolerance
    qp.settings.eps_rel = 0.0
    qp.settings.max_iter = _OUTER_ITERATIONS
    qp.settings.max_iter_in = _INNER_ITERATIONS
    qp.settings.eps_primal_inf = _INFEASIBILITY_TOLERANCE
    # Started from the last solution, ProxQP 0.8 now and then returns one whose multipliers have
    # the wrong sign, 2% above the least cost; what is easy has been solved before it is asked.
    qp.settings.initial_guess = proxqp.InitialGuess.NO_INITIAL_GUESS


def _result(qp: proxqp.dense.QP, n: int) -> tuple[np.ndarray | None, int]:
    qp.solve()
    iterations = qp.results.info.iter
    if qp.results.info.status != proxqp.QPSolverOutput.PROXQP_SOLVED:
        return None, iterations
    x = np.array(qp.results.x[:n])
    return (x if np.isfinite(x).all() else None), iterations
