# SPDX-License-Identifier: Apache-2.0
"""What may be sent to the motors: finite torques within their limits and rates."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike


class TorqueLimiter:
    """Keeps torques within their limits, and within reach of the last one.

    Args:
        tau_max: torque limits, shape (n,), N m.
        tau_rate_max: greatest change of torque, shape (n,), N m/s; inf or None for none.
        dt: control period, s.

    Attributes:
        tau_max: as given.
        last: torque sent last, shape (n,), N m; None before the first.
    """

    def __init__(self, tau_max: ArrayLike, tau_rate_max: ArrayLike | None, dt: float) -> None:
        self.tau_max = np.asarray(tau_max, dtype=float)
        self._tau_min = -self.tau_max
        rate = np.asarray(math.inf if tau_rate_max is None else tau_rate_max, dtype=np.float64)
        self._step = np.where(np.isinf(rate), np.inf, rate * dt)
        self._rate_limited = bool(np.isfinite(rate).any())
        self.last: np.ndarray | None = None

    def reset(self) -> None:
        """Forget the last torque: the next may be any within the limits."""
        self.last = None

    def go_on_from(self, tau: np.ndarray) -> np.ndarray:
        """Take `tau`, shape (n,), N m, within the limits, for the torque sent last; return it."""
        self.last = np.clip(tau, self._tau_min, self.tau_max)
        return self.last

    def range(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the least and greatest torques that may follow, shape (n,) each, N m."""
        if self.last is None or not self._rate_limited:
            return self._tau_min, self.tau_max
        return (
            np.maximum(self._tau_min, self.last - self._step),
            np.minimum(self.tau_max, self.last + self._step),
        )

    def limited(self, tau: np.ndarray) -> np.ndarray:
        """Return `tau` as it may be sent: whatever came before, finite and within the limits."""
        if not math.isfinite(tau.dot(tau)):
            tau = np.zeros(self.tau_max.size) if self.last is None else self.last
        lower, upper = self.range()
        self.last = np.minimum(np.maximum(tau, lower), upper)
        return self.last
