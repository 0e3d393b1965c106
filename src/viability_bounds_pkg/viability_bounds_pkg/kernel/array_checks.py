"""Checks of short arrays, compiled: through NumPy they cost more than the control law."""

from __future__ import annotations

import math

import numpy as np

from viability_bounds_pkg.compiled import compiled


@compiled
def both_finite(x: np.ndarray, y: np.ndarray) -> bool:
    """Return whether no number in two arrays of shape (n,) is infinite or NaN."""
    for i in range(len(x)):
        if not (math.isfinite(x[i]) and math.isfinite(y[i])):
            return False
    return True


@compiled
def in_order(lower: np.ndarray, upper: np.ndarray) -> bool:
    """Return whether nowhere in two arrays of shape (n,) the lower number is above the upper."""
    for i in range(len(lower)):
        if not lower[i] <= upper[i]:
            return False
    return True
