# SPDX-License-Identifier: Apache-2.0
"""Checks of array arguments."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def finite_vector(name: str, value: ArrayLike, size: int, *, signed: bool = True) -> Array:
    """Return `value` as an array of `size` finite numbers, not negative unless `signed`.

    Raises:
        ValueError: it is not.
    """
    array = np.asarray(value, dtype=float)
    if array.shape != (size,) or not np.isfinite(array).all():
        raise ValueError(f"{name} must be {size} finite numbers, not {value!r}")
    if not signed and np.any(array < 0.0):
        raise ValueError(f"{name} must not be negative: {array}")
    return array
