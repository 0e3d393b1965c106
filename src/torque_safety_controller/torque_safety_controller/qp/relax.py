# SPDX-License-Identifier: Apache-2.0
"""Least relaxation of limits that contradict the torque limits, by explicit slacks.

With S x what may be relaxed, the bounded a and G a, it is the e of

    minimise |e|^2   subject to   S x - e, rho and the torques in limits.

The torque limits alone always have a solution, without force, as M is regular. Soft constraints
of DAQP would weigh each row by H, and relax up to 2.8 times as much.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from torque_safety_controller.qp.program import NoSolutionFound, QuadraticProgram
from torque_safety_controller.qp.solvers import Solver, Status, first_to_solve

Array = NDArray[np.float64]

# Room that is left to the tasks beyond the least relaxation, relative to it where it is above 1,
# and to the length of a row where that is.
_ROOM = 1e-8
_LONGEST = 1e4
"""Constraints with longer rows are scaled to this length when limits must be relaxed."""


def relaxed_least(
    program: QuadraticProgram, n: int, solvers: Iterable[Solver]
) -> tuple[QuadraticProgram, Array, int]:
    """Move the limits of a and G a by the least that leaves the torque limits a solution.

    It is solved for z = L' a, with M = L L': then the rows are no worse conditioned than L,
    whose condition number is the square root of that of M.

    Args:
        program: of `InverseDynamicsQP.build`, without a solution.
        n: number of joints.
        solvers: asked in turn until one finds the least relaxation.

    Returns:
        The program with moved limits, a point x within them, shape (p,), which serves no task,
        and the iterations.

    Raises:
        NoSolutionFound: M is no mass matrix, or the numbers are absurd.
    """
    H, g, C, lower, upper = (each.copy() for each in program)
    size = len(g)
    try:
        from_z = np.linalg.inv(np.linalg.cholesky(C[:n, :n])).T
    except np.linalg.LinAlgError as error:
        message = "the mass matrix is not positive definite"
        raise NoSolutionFound(message, program) from error
    relaxable = np.r_[:n, size + n : len(lower)]  # where the limits of S x are
    soft = len(relaxable)
    # Beyond this length a row would make the problem too ill-conditioned.
    length = np.maximum(np.linalg.norm(C[n:], axis=1) / _LONGEST, 1.0)
    C[n:] /= length[:, None]
    lower[size + n :] /= length
    upper[size + n :] /= length
    rows = np.zeros((n + soft, size + soft))
    rows[:n, :size] = C[:n]
    rows[n : 2 * n, :n] = np.eye(n)
    rows[2 * n :, :size] = C[n:]
    rows[n:, size:] = -np.eye(soft)
    rows[:, :n] = rows[:, :n] @ from_z

    def limits(limit: Array, free: float) -> Array:
        a, rho, tau = np.full(n, free), limit[n:size], limit[size : size + n]
        return np.concatenate([a, rho, np.full(soft, free), tau, limit[relaxable]])

    cost = np.diag(np.repeat([0.0, 1.0], [size, soft]))
    least = first_to_solve(
        solvers,
        QuadraticProgram(
            cost, np.zeros(size + soft), rows, limits(lower, -np.inf), limits(upper, np.inf)
        ),
    )
    if least.status is not Status.SOLVED:
        raise NoSolutionFound("no accelerations within the torque limits were found", program)
    e = least.x[size:]
    room = _ROOM * max(1.0, float(np.abs(e).max()))
    lower[relaxable] += np.minimum(e, 0.0) - room
    upper[relaxable] += np.maximum(e, 0.0) + room
    x = np.concatenate([from_z @ least.x[:n], least.x[n:size]])
    return QuadraticProgram(H, g, C, lower, upper), x, least.iterations
