# SPDX-License-Identifier: Apache-2.0
"""The QP of (11) by a general solver, for tests."""

import numpy as np
from proxsuite import proxqp


def nearest(u, lower, upper, s, level):
    """Minimise |x - u|^2 subject to lower <= x <= upper and s'x >= level, by ProxQP.

    None where it does not converge.
    """
    n, scale = len(u), np.abs(s).max() or 1.0
    qp = proxqp.dense.QP(n, 0, n + 1)
    qp.settings.eps_abs, qp.settings.eps_rel = 1e-11, 0.0
    qp.settings.check_duality_gap = True  # without, it stops up to 1e-5 short
    qp.settings.eps_duality_gap_abs, qp.settings.eps_duality_gap_rel = 1e-11, 0.0
    C = np.vstack([np.eye(n), s / scale])
    qp.init(np.eye(n), -u, None, None, C, np.r_[lower, level / scale], np.r_[upper, np.inf])
    qp.solve()
    solved = qp.results.info.status == proxqp.QPSolverOutput.PROXQP_SOLVED
    return np.array(qp.results.x) if solved else None
