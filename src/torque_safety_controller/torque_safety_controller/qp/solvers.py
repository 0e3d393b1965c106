# SPDX-License-Identifier: Apache-2.0
"""Solvers of quadratic programs: DAQP by default, ProxQP by name or where DAQP fails.

DAQP [Arnstrom2022] is a dual active-set method, certain about infeasibility. It is asked where the
limits active last are not those active now, as a linear system tells in much less time. It does
not look at its input: NaN in C passes as a limit that is never violated.
ProxQP is an augmented Lagrangian method; version 0.8 goes on for seconds where there is no
solution, and now and then calls solved what has a duality gap. So answers of both are checked.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from enum import Enum
from typing import NamedTuple, Protocol

import daqp
import numpy as np
from numba import njit
from numpy.typing import NDArray
from proxsuite import proxqp

from torque_safety_controller.qp.program import QuadraticProgram

Array = NDArray[np.float64]

_TOLERANCE = 1e-9
"""Violation of a limit, in its unit, that counts as none."""

_SETTINGS: dict[str, float] = {
    "primal_tol": _TOLERANCE,
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
        active = self._active.get(C.shape)
        if active is None:
            active = self._active[C.shape] = np.zeros(len(lower), dtype=np.int32)
        x = np.empty(len(g))
        if solved_by(active, H, g, C, lower, upper, x):
            return SolverResult(Status.SOLVED, x, 1)
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
    return SolverResult(status, x, info["iterations"])


def _is_valid(program: QuadraticProgram) -> bool:
    """Return whether all is finite that must be, and limits are not crossed."""
    H, g, C, lower, upper = program
    return bool(
        all(np.isfinite(each).all() for each in (H, g, C))
        and (lower <= upper).all()
        and (lower < np.inf).all()
        and (upper > -np.inf).all()
    )


# Compiled, because they are called at every step and NumPy takes twenty times as long.


@njit(cache=True)
def solved_by(
    active: NDArray[np.int32], H: Array, g: Array, C: Array, lower: Array, upper: Array, x: Array
) -> bool:
    """Return whether the solution has these limits active; if so, write it to x.

    With the active limits as equalities A x = b it is

        (H, A'; A, 0) (x, lambda) = (-g, b).

    It is right if x is within all limits, and no multiplier pulls towards its own.

    Args:
        active: 1 for upper limits, 3 for lower ones, else 0, shape (p + m,).
        H: this and the next ones as of a `QuadraticProgram`.
        g: shape (p,).
        C: shape (m, p).
        lower: shape (p + m,).
        upper: same shape.
        x: shape (p,), written.
    """
    m, p = C.shape
    size = p + np.count_nonzero(active)
    if size > 2 * p:
        return False
    system = np.zeros((size, size + 1))
    system[:p, :p] = H
    system[:p, size] = -g
    row = p
    for i in range(p + m):
        if not lower[i] <= upper[i]:
            return False
        if active[i] != 0:
            if i < p:
                system[row, i] = system[i, row] = 1.0
            else:
                for j in range(p):
                    system[row, j] = system[j, row] = C[i - p, j]
            system[row, size] = upper[i] if active[i] == 1 else lower[i]
            row += 1
    if not _eliminated(system):
        return False
    multipliers, row = np.zeros(p + m), p
    for i in range(p + m):
        if active[i] != 0:
            multipliers[i] = system[row, size]
            row += 1
            if lower[i] < upper[i] and multipliers[i] * (2 - active[i]) < 0.0:
                return False
    for i in range(p):
        x[i] = system[i, size]
        if not lower[i] - _TOLERANCE <= x[i] <= upper[i] + _TOLERANCE:
            return False
    return clip_and_check(x, C, lower, upper, _TOLERANCE, multipliers, active)


@njit(cache=True)
def _eliminated(system: Array) -> bool:
    """Solve A z = b, given as (A, b), by Gauss; z takes the place of b. False if A is singular."""
    n = len(system)
    for i in range(n):
        pivot = i
        for row in range(i + 1, n):
            if abs(system[row, i]) > abs(system[pivot, i]):
                pivot = row
        if system[pivot, i] == 0.0:
            return False
        for j in range(i, n + 1):
            system[i, j], system[pivot, j] = system[pivot, j], system[i, j]
        for row in range(i + 1, n):
            factor = system[row, i] / system[i, i]
            if factor != 0.0:
                for j in range(i + 1, n + 1):
                    system[row, j] -= factor * system[i, j]
    for i in range(n - 1, -1, -1):
        for j in range(i + 1, n):
            system[i, n] -= system[i, j] * system[j, n]
        system[i, n] /= system[i, i]
    return True


@njit(cache=True)
def clip_and_check(
    x: Array,
    C: Array,
    lower: Array,
    upper: Array,
    violation: float,
    multipliers: Array,
    sense: NDArray[np.int32],
) -> bool:
    """Clip x to its own limits, in place; return whether it and C x are finite and in limits.

    Args:
        x: shape (p,).
        C: shape (m, p).
        lower: of x, then of C x, shape (p + m,).
        upper: same shape.
        violation: that is allowed of the limits of C x.
        multipliers: shape (p + m,), > 0 where the upper limit is active, < 0 for the lower.
        sense: shape (p + m,), written: what is active, as DAQP takes it.
    """
    m, p = C.shape
    for i in range(p):
        if not (math.isfinite(x[i]) and lower[i] <= upper[i]):
            return False
        x[i] = min(max(x[i], lower[i]), upper[i])
    for i in range(m):
        value = 0.0
        for j in range(p):
            value += C[i, j] * x[j]
        low, high = lower[p + i] - violation, upper[p + i] + violation
        # So put that it is false where something is NaN.
        if not (math.isfinite(value) and low <= value <= high):
            return False
    for i in range(m + p):
        sense[i] = 1 if multipliers[i] > 0.0 else 3 if multipliers[i] < 0.0 else 0
    return True
