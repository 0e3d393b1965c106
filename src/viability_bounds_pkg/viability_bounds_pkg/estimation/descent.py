"""Descent to a local minimum in the unit cube.

In place of SciPy's L-BFGS-B, which on busy cores made the searches here several times slower
through the threads of OpenBLAS. It also asks for a gradient only where a step was accepted, and a
gradient costs as much as a value here.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

FIRST_STEP = 1.0
"""Longest component of the first step, in edges of the cube."""

TRIALS = 5
"""Step lengths tried before a search gives up, each `SHORTER` times the one before."""

SHORTER = 0.3

SUFFICIENT = 1e-4
"""Part of the decrease a gradient promises that a step must bring (Armijo's condition)."""


def descend(
    value: Callable[[Array], float],
    gradient: Callable[[Array], Array],
    start: Array,
    steps: int,
    tolerance: float,
) -> None:
    """Minimise by projected quasi-Newton steps (BFGS on the coordinates not held at a bound).

    Args:
        value: the function; the caller keeps the best point by watching its calls.
        gradient: its gradient, shape (d,), called only with the point last accepted.
        start: in the unit cube, shape (d,).
        steps: the most steps.
        tolerance: a step that brings less than this part of the value is the last.
    """
    x, f = start, value(start)
    slope = gradient(x)
    inverse = None  # of the Hessian
    for _ in range(steps):
        free = ~((x <= 0.0) & (slope > 0.0) | (x >= 1.0) & (slope < 0.0))
        downhill = np.where(free, -slope, 0.0)
        steepest = np.abs(downhill).max()
        if steepest == 0.0:
            return
        direction = downhill * (FIRST_STEP / steepest)
        if inverse is not None:
            newton = np.where(free, inverse @ downhill, 0.0)
            direction = newton if newton @ downhill > 0.0 else direction
        for trial in range(TRIALS):
            candidate = np.clip(x + SHORTER**trial * direction, 0.0, 1.0)
            f_candidate = value(candidate)
            if f_candidate < f + SUFFICIENT * (slope @ (candidate - x)):
                break
        else:
            return
        if f - f_candidate < tolerance * abs(f):
            return
        slope_candidate = gradient(candidate)
        inverse = _updated(inverse, candidate - x, slope_candidate - slope)
        x, f, slope = candidate, f_candidate, slope_candidate


def _updated(inverse: Array | None, step: Array, change: Array) -> Array | None:
    """Return the BFGS update of the inverse Hessian; the old one where curvature is not positive.

    Args:
        inverse: what it was, shape (d, d), or None before the first update.
        step: change of the point, shape (d,).
        change: change of the gradient, shape (d,).
    """
    curvature = step @ change
    if curvature <= 1e-12:
        return inverse
    if inverse is None:
        inverse = np.eye(len(step)) * (curvature / (change @ change))
    moved = inverse @ change
    cross = np.outer(moved, step)
    return (
        inverse
        + (1.0 + change @ moved / curvature) / curvature * np.outer(step, step)
        - (cross + cross.T) / curvature
    )
