# SPDX-License-Identifier: Apache-2.0
"""DAQP, a dual active-set method: fast from a good guess, and certain about infeasibility.

DAQP [Arnstrom2022] does not look at its input: NaN in C passes as a limit that is never violated.
So what it calls a solution is checked against the limits.
"""

from __future__ import annotations

import daqp
import numpy as np
from numpy.typing import NDArray

from torque_safety_controller.qp.kernels import clip_and_check
from torque_safety_controller.qp.quadratic_program import QuadraticProgram, SolverResult, Status

Array = NDArray[np.float64]

_SETTINGS: dict[str, float] = {
    "primal_tol": 1e-9,
    "iter_limit": 1000,
    "eta_prox": 1e-10,
    "sing_tol": 1e-13,
    "eq_reduction": -1,
}
_LOOSE = {"primal_tol": 5e-7, "eta_prox": 1e-6}
_INFEASIBLE = (-1, -6)  # exit flags of DAQP; the second: equalities that contradict each other
_LARGE = 1e4
VIOLATION = 1e-6
"""Largest violation of a limit, in its unit, of what is taken for a solution."""


class DaqpSolver:
    """Solves programs with DAQP, starting from the limits active in the last of the same size.

    Args:
        proximal: for costs that are flat in some directions, with a diagonal H: weight of the
            distance from the last iterate, by which DAQP makes them strictly convex. The result
            is exact all the same. With 0 a flat cost is a failure.
    """

    def __init__(self, proximal: float = 0.0) -> None:
        self._settings = _SETTINGS | {"eps_prox": -proximal}  # negative: only where H is singular
        self._active: dict[tuple[int, ...], NDArray[np.int32]] = {}

    def solve(self, program: QuadraticProgram) -> SolverResult:
        """Return the minimum, or why there is none; see `Solver`."""
        size = program.C.shape
        active = self._active.get(size)
        if active is None:
            active = self._active[size] = np.zeros(len(program.lower), dtype=np.int32)
        result = _solve(program, active, self._settings)
        if result.status is not Status.SOLVED:
            # The guess may have been misleading, equalities contradictory by rounding only, or the
            # numbers too large for tolerances that are absolute.
            active[:] = 0
            scale = _scale(program)
            result = _solve(_divided(program, scale), active, self._settings | _LOOSE)
            n = len(program.g)
            x = np.clip(scale * result.x, program.lower[:n], program.upper[:n])
            result = result._replace(x=x)
        return result


def _solve(
    program: QuadraticProgram, active: NDArray[np.int32], settings: dict[str, float]
) -> SolverResult:
    """Solve from a guess of the active limits, which receives those of the solution."""
    H, g, C, lower, upper = program
    x, _, flag, info = daqp.solve(H, g, C, upper, lower, active, **settings)
    if flag < 0:
        valid = flag in _INFEASIBLE and _is_valid(program)
        status = Status.INFEASIBLE if valid else Status.FAILED
    elif clip_and_check(x, C, lower, upper, VIOLATION, info["lam"], active):
        status = Status.SOLVED
    else:
        status = Status.FAILED
    return SolverResult(status, x, info["iterations"])


def _scale(program: QuadraticProgram) -> float:
    """Return by what to divide x to keep the limits below `_LARGE`; 1 if they are."""
    limits = np.abs(np.concatenate([program.lower, program.upper]))
    return max(1.0, float(limits[np.isfinite(limits)].max(initial=0.0)) / _LARGE)


def _divided(program: QuadraticProgram, scale: float) -> QuadraticProgram:
    """Return the program for ``x / scale``."""
    H, g, C, lower, upper = program
    return QuadraticProgram(H, g / scale, C, lower / scale, upper / scale)


def _is_valid(program: QuadraticProgram) -> bool:
    """Return whether all is finite that must be, and limits are not crossed."""
    H, g, C, lower, upper = program
    return bool(
        all(np.isfinite(each).all() for each in (H, g, C))
        and (lower <= upper).all()
        and (lower < np.inf).all()
        and (upper > -np.inf).all()
    )
