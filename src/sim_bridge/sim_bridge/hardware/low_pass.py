# SPDX-License-Identifier: Apache-2.0
"""A first-order low-pass filter, as drives have it for their velocities."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class LowPass:
    """First-order low-pass y' = omega (u - y), exact for inputs that are constant in between.

    Args:
        cutoff_hz: omega / (2 pi), Hz, positive.
        dt: time between two updates, s.
    """

    def __init__(self, cutoff_hz: float, dt: float) -> None:
        self._gain = -math.expm1(-2.0 * math.pi * cutoff_hz * dt)
        self._value: Array = np.zeros(0)

    def reset(self, value: Array) -> None:
        """Set the output."""
        self._value = value

    def update(self, value: Array) -> Array:
        """Return the output after `value` has been the input for the time of one update."""
        self._value = self._value + self._gain * (value - self._value)
        return self._value
