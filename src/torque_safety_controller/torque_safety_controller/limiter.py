# SPDX-License-Identifier: Apache-2.0
"""Limits of commanded torques and of their rates of change."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import ArrayLike


class TorqueLimiter:
    """Clips torques to their limits and to the rate limit; replaces those that are not finite.

    Args:
        tau_max: torque limits, shape (n,), N m.
        tau_rate_max: greatest change of torque, shape (n,), N m/s; inf or None for none.
        dt: control period, s.

    Attributes:
        tau_max: as given.
        last: last commanded torque, shape (n,), N m; None before the first.
    """

    def __init__(self, tau_max: ArrayLike, tau_rate_max: ArrayLike | None, dt: float) -> None:
        self.tau_max = np.array(tau_max, dtype=float)
        self._limits = -self.tau_max, self.tau_max
        rate = np.asarray(math.inf if tau_rate_max is None else tau_rate_max, dtype=np.float64)
        finite = np.isfinite(rate)
        self._step = np.multiply(rate, dt, out=np.full(rate.shape, np.inf), where=finite)
        self._rate_limited = bool(finite.any())
        self.last: np.ndarray | None = None

    def reset(self) -> None:
        """Forget the last torque; the next is not rate-limited."""
        self.last = None

    def continue_from(self, tau: np.ndarray) -> np.ndarray:
        """Set the last torque to `tau`, shape (n,), N m, clipped to the limits; return it."""
        self.last = np.clip(tau, *self._limits)
        return self.last

    def range(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the lower and the upper limits of the next torque, shape (n,) each, N m."""
        if self.last is None or not self._rate_limited:
            return self._limits
        lower, upper = self.last - self._step, self.last + self._step
        return np.clip(lower, *self._limits), np.clip(upper, *self._limits)

    def limited(self, tau: np.ndarray) -> np.ndarray:
        """Return `tau` clipped to the limits; the last torque in place of one not finite."""
        limited = np.zeros(self.tau_max.size)
        lower, upper = self.range()
        if not _clip(tau, lower, upper, limited):
            _clip(limited if self.last is None else self.last, lower, upper, limited)
        self.last = limited
        return limited


@njit(cache=True)
def _clip(tau: np.ndarray, lower: np.ndarray, upper: np.ndarray, limited: np.ndarray) -> bool:
    """Write `tau` within its limits; return whether it is finite, else nothing is written."""
    square = 0.0
    for torque in tau:
        square += torque * torque
    if not math.isfinite(square):
        return False
    for j in range(tau.size):
        limited[j] = min(max(tau[j], lower[j]), upper[j])
    return True
