# SPDX-License-Identifier: Apache-2.0
"""Solvers of quadratic programs: DAQP by default, ProxQP by name or where DAQP fails.

DAQP [Arnstrom2022] is a dual active-set method, certain about infeasibility. It does not look at
its input: NaN in C passes as a limit that is never violated.
ProxQP is an augmented Lagrangian method; version 0.8 goes on for seconds where there is no
solution, and now and then calls solved what has a duality gap. So answers of both are checked.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from enum import Enum
from typing import NamedTuple, Protocol

import daqp
import numpy as np
from numpy.typing import NDArray
from proxsuite import proxqp

from torque_safety_controller.qp.active_set import TOLERANCE, clip_and_check, solved_by
from torque_safety_controller.qp.program import QuadraticProgram

Array = NDArray[np.float64]

_SETTINGS: dict[str, float] = {
    "primal_tol": TOLERANCE,
    "iter_limit": 1000,
    "eta_prox": 1e-10,
    "sing_tol": 1e-13,
    "eq_reduction": -1,
}
_LOOSE = {"primal_tol": 5e-7, "eta_prox": 1e-6}
_INFEASIBLE = (-1, -6)  # exit flags of DAQP; the second: equalities that contradict each other
_LARGE = 1e4
VIOLATION = 1e-6
"""Largest violation of a limit, in its unit, of what is taken for a solution of DAQP."""

_PROXQP: dict[str, float] = {
    "eps_abs": 1e-9,
    "eps_rel": 0.0,
    # Solutions take a few; a problem without one goes on for 15 s under the default limits.
    "max_iter": 60,
    "max_iter_in": 100,
    "eps_primal_inf": 1e-8,
}
_GAP = 1e-5
"""Largest duality gap, relative to the cost or 1, of what is taken for a solution of ProxQP."""


class Status(Enum):
    """How an attempt to solve a program ended."""

    SOLVED = "solved"
    INFEASIBLE = "no point is within all limits"
    FAILED = "not finite, limits crossed, or not solved to the tolerance"


class SolverResult(NamedTuple):
    """What a solver returned."""

    status: Status
    x: Array
    """Shape (p,), within its own limits exactly; means nothing unless solved."""
    iterations: int
    active: NDArray[np.int32] | None = None
    """What is active, 1 for upper limits, 3 for lower ones, else 0, shape (p + m,), if known."""


class Solver(Protocol):
    """Anything that solves quadratic programs; their sizes may change from call to call."""

    def solve(self, program: QuadraticProgram) -> SolverResult:
        """Return the minimum, or why there is none. Never raises for what the numbers are."""


class DaqpSolver:
    """Solves programs by the limits active in the last of the same size, or with DAQP from them.

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
        H, g, C, lower, upper = program
        active = self._active.setdefault(C.shape, np.zeros(len(lower), dtype=np.int32))
        x = np.empty(len(g))
        if solved_by(active, H, g, C, lower, upper, x):
            return SolverResult(Status.SOLVED, x, 1, active)
        result = _solve(program, active, self._settings)
        if result.status is Status.SOLVED:
            return result
        # The guess may have been misleading, equalities contradictory by rounding only, or the
        # numbers too large for tolerances that are absolute.
        active[:] = 0
        limits = np.abs(np.concatenate([lower, upper]))
        scale = max(1.0, float(limits[np.isfinite(limits)].max(initial=0.0)) / _LARGE)
        scaled = QuadraticProgram(H, g / scale, C, lower / scale, upper / scale)
        result = _solve(scaled, active, self._settings | _LOOSE)
        n = len(g)
        return result._replace(x=np.clip(scale * result.x, lower[:n], upper[:n]))


class ProxqpSolver:
    """Solves programs with ProxQP, each from the start."""

    def solve(self, program: QuadraticProgram) -> SolverResult:
        """Return the minimum, or why there is none; see `Solver`.

        ProxQP cannot tell for certain that there is no solution: where it found none within its
        iterations, the status is that of an infeasible program.
        """
        H, g, C, lower, upper = program
        n = len(g)
        if not _is_valid(program):
            return SolverResult(Status.FAILED, np.empty(n), 0)
        qp = proxqp.dense.QP(n, 0, len(C), True)
        for name, value in _PROXQP.items():
            setattr(qp.settings, name, value)
        qp.settings.initial_guess = proxqp.InitialGuess.NO_INITIAL_GUESS
        qp.settings.check_duality_gap = True
        qp.settings.eps_duality_gap_abs = _GAP * (1.0 + float(np.abs(g).max(initial=0.0)))
        qp.init(H, g, None, None, C, lower[n:], upper[n:], lower[:n], upper[:n])
        qp.solve()
        x = np.array(qp.results.x)
        solved = qp.results.info.status == proxqp.QPSolverOutput.PROXQP_SOLVED
        status = Status.SOLVED if solved and np.isfinite(x).all() else Status.INFEASIBLE
        return SolverResult(status, np.clip(x, lower[:n], upper[:n]), int(qp.results.info.iter))


SOLVERS: dict[str, Callable[[], Solver]] = {"daqp": DaqpSolver, "proxqp": ProxqpSolver}
"""By name; a solver that fails for numerical reasons is followed by the next one."""


def first_to_solve(solvers: Iterable[Solver], program: QuadraticProgram) -> SolverResult:
    """Return the first solution; if there is none, what the last solver says."""
    for solver in solvers:
        result = solver.solve(program)
        if result.status is Status.SOLVED:
            break
    return result


def _solve(
    program: QuadraticProgram, active: NDArray[np.int32], settings: dict[str, float]
) -> SolverResult:
    """Solve by DAQP from a guess of the active limits, which receives those of the solution."""
    H, g, C, lower, upper = program
    x, _, flag, info = daqp.solve(H, g, C, upper, lower, active, **settings)
    if flag < 0:
        valid = flag in _INFEASIBLE and _is_valid(program)
        status = Status.INFEASIBLE if valid else Status.FAILED
    elif clip_and_check(x, C, lower, upper, VIOLATION, info["lam"], active):
        status = Status.SOLVED
    else:
        status = Status.FAILED
    return SolverResult(status, x, info["iterations"], active)


def _is_valid(program: QuadraticProgram) -> bool:
    """Return whether all is finite that must be, and limits are not crossed."""
    H, g, C, lower, upper = program
    return bool(
        all(np.isfinite(each).all() for each in (H, g, C))
        and (lower <= upper).all()
        and (lower < np.inf).all()
        and (upper > -np.inf).all()
    )
