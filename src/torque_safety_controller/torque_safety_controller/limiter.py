# SPDX-License-Identifier: Apache-2.0
"""Limits of commanded torques and of their rates of change."""

from __future__ import annotations

import math

import numpy as np
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
        self._tau_min = -self.tau_max
        rate = np.asarray(math.inf if tau_rate_max is None else tau_rate_max, dtype=np.float64)
        self._step = np.where(np.isinf(rate), np.inf, rate * dt)
        self._rate_limited = bool(np.isfinite(rate).any())
        self.last: np.ndarray | None = None

    def reset(self) -> None:
        """Forget the last torque; the next is not rate-limited."""
        self.last = None

    def continue_from(self, tau: np.ndarray) -> np.ndarray:
        """Set the last torque to `tau`, shape (n,), N m, clipped to the limits; return it."""
        self.last = np.clip(tau, self._tau_min, self.tau_max)
        return self.last

    def range(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the limits of the next torque, shape (n,) each, N m."""
        if self.last is None or not self._rate_limited:
            return self._tau_min, self.tau_max
        return (
            np.maximum(self._tau_min, self.last - self._step),
            np.minimum(self.tau_max, self.last + self._step),
        )

    def limited(self, tau: np.ndarray) -> np.ndarray:
        """Return `tau` clipped to the limits; the last torque in place of one not finite."""
        if not math.isfinite(tau.dot(tau)):
            tau = np.zeros(self.tau_max.size) if self.last is None else self.last
        lower, upper = self.range()
        self.last = np.minimum(np.maximum(tau, lower), upper)
        return self.last
