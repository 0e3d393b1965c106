"""Checks of arrays that callers pass."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike


def finite_vector(name: str, value: ArrayLike, size: int) -> np.ndarray:
    """Return `value` as an array of `size` finite numbers, or raise `ValueError`."""
    array = np.asarray(value, dtype=float)
    if array.shape != (size,) or not np.isfinite(array).all():
        raise ValueError(f"{name} must be {size} finite numbers, not {value}")
    return array


def not_negative_vector(name: str, value: ArrayLike, size: int) -> np.ndarray:
    """Return `value` as an array of `size` finite numbers >= 0, or raise `ValueError`."""
    array = finite_vector(name, value, size)
    if np.any(array < 0.0):
        raise ValueError(f"{name} must not be negative: {array}")
    return array
