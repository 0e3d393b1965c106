"""The same small dense QPs as `active_set.minimise`, by ProxQP.

A second opinion where the active-set method gives up, and the solver itself for who asks for it.
It has to be watched: ProxQP 0.8 goes on for seconds where there is no solution, and now and then
calls solved what has a duality gap.
"""

from __future__ import annotations

import numpy as np
from proxsuite import proxqp

from torque_safety_controller.qp.active_set import FAILED, INFEASIBLE

_TOLERANCE = 1e-9
# Solutions take a few; a problem without one goes on for 15 s under the default limits.
_OUTER_ITERATIONS = 60
_INNER_ITERATIONS = 100
_INFEASIBILITY_TOLERANCE = 1e-8
_GAP = 1e-5
"""Largest duality gap, relative to the cost or 1, of what is taken for a solution."""


def minimise(
    H: np.ndarray,
    g: np.ndarray,
    C: np.ndarray,
    lower: np.ndarray,
    upper: np.ndarray,
    side: np.ndarray,
    x: np.ndarray,
) -> int:
    """Solve ``min x'Hx / 2 + g'x`` subject to ``lower <= (x, C x) <= upper``.

    Args:
        H: shape (n, n), positive definite.
        g: shape (n,).
        C: shape (m, n).
        lower: of x, then of C x, shape (n + m,); may be -inf.
        upper: shape (n + m,); may be inf.
        side: taken for the sake of the interface; ProxQP starts from nothing each time.
        x: shape (n,), receives the solution.

    Returns:
        Iterations; `active_set.FAILED` for numbers that are not finite or limits that are crossed;
        else `active_set.INFEASIBLE`, also where ProxQP could not decide within its iterations.
    """
    n, m = len(g), len(C)
    if not all(np.isfinite(each).all() for each in (H, g, C)) or not (lower <= upper).all():
        return FAILED
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
    found = np.array(qp.results.x)
    solved = qp.results.info.status == proxqp.QPSolverOutput.PROXQP_SOLVED
    if not (solved and np.isfinite(found).all()):
        return INFEASIBLE
    x[:] = np.clip(found, lower[:n], upper[:n])
    return int(qp.results.info.iter)
