# SPDX-License-Identifier: Apache-2.0
"""ProxQP, an augmented Lagrangian method: the solver to ask where DAQP fails, or by choice.

Its answers are checked: ProxQP 0.8 goes on for seconds where there is no solution, and now and
then calls solved what has a duality gap.
"""

from __future__ import annotations

import numpy as np
from proxsuite import proxqp

from torque_safety_controller.qp.quadratic_program import QuadraticProgram, SolverResult, Status

_TOLERANCE = 1e-9
# Solutions take a few; a problem without one goes on for 15 s under the default limits.
_OUTER_ITERATIONS = 60
_INNER_ITERATIONS = 100
_INFEASIBILITY_TOLERANCE = 1e-8
_GAP = 1e-5
"""Largest duality gap, relative to the cost or 1, of what is taken for a solution."""


class ProxqpSolver:
    """Solves programs with ProxQP, each from the start."""

    def solve(self, program: QuadraticProgram) -> SolverResult:
        """Return the minimum, or why there is none; see `Solver`.

        ProxQP cannot tell for certain that there is no solution: where it found none within its
        iterations, the status is that of an infeasible program.
        """
        H, g, C, lower, upper = program
        n, m = len(g), len(C)
        finite = all(np.isfinite(each).all() for each in (H, g, C))
        if not finite or not (lower <= upper).all():
            return SolverResult(Status.FAILED, np.empty(n), 0)
        qp = proxqp.dense.QP(n, 0, m, True)
        settings = qp.settings
        settings.eps_abs, settings.eps_rel = _TOLERANCE, 0.0
        settings.max_iter, settings.max_iter_in = _OUTER_ITERATIONS, _INNER_ITERATIONS
        settings.eps_primal_inf = _INFEASIBILITY_TOLERANCE
        settings.initial_guess = proxqp.InitialGuess.NO_INITIAL_GUESS
        settings.check_duality_gap = True
        cost = 1.0 + float(np.abs(g).max(initial=0.0))
        settings.eps_duality_gap_abs = _GAP * cost
        qp.init(H, g, None, None, C, lower[n:], upper[n:], lower[:n], upper[:n])
        qp.solve()
        x = np.array(qp.results.x)
        solved = qp.results.info.status == proxqp.QPSolverOutput.PROXQP_SOLVED
        status = Status.SOLVED if solved and np.isfinite(x).all() else Status.INFEASIBLE
        return SolverResult(status, np.clip(x, lower[:n], upper[:n]), int(qp.results.info.iter))
