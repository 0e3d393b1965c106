# SPDX-License-Identifier: Apache-2.0
"""Leaky integration, which forgets: eq. (12)-(14), [Benallegue2021].

    s_leaky' = -theta s_leaky + s'

With theta = 0 it is s; otherwise what happened a time t ago counts with exp(-theta t).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def leak_factors(theta: float, dt: float, paper_form: bool) -> tuple[float, float]:
    """Return what a step leaves of the past, and what it takes of the increment of s.

    Exactly, for s' constant within the step, (12) gives

        s_leaky(dt) = exp(-theta dt) s_leaky(0) + (1 - exp(-theta dt)) / (theta dt) * increment.

    Args:
        theta: leak rate, 1/s, >= 0.
        dt: step, s, >= 0.
        paper_form: take the whole increment, as eq. (13) does: as if all of it came at the end of
            the step.
    """
    x = theta * dt
    decay = math.exp(-x)
    if paper_form or x == 0.0:
        return decay, 1.0
    return decay, -math.expm1(-x) / x


class LeakyIntegrator:
    """Leaky integral of s', from samples of s; starts at zero, as s does.

    Args:
        theta: leak rate, 1/s, finite and >= 0: after 1 / theta seconds, 63% of the past is
            forgotten. 0 for a plain integrator.
        n: number of components.

    Attributes:
        value: leaky integral, shape (n,).

    Raises:
        ValueError: theta or n out of range.
    """

    def __init__(self, theta: float, n: int) -> None:
        if n < 1:
            raise ValueError(f"n must be at least 1, is {n}")
        if not 0.0 <= theta < math.inf:
            raise ValueError(f"theta must be a finite number >= 0, is {theta}")
        self._theta = theta
        self.value: Array = np.zeros(n)
        self._s_last: Array = np.zeros(n)

    def update(self, s: ArrayLike, dt: float) -> Array:
        """Take a new sample and return the leaky integral, shape (n,).

        Args:
            s: shape (n,).
            dt: time since the last sample, s, finite and >= 0.

        Raises:
            ValueError: s or dt is unusable; nothing has changed then.
        """
        s = np.array(s, dtype=np.float64)
        if s.shape != self.value.shape or not np.isfinite(s).all():
            raise ValueError(f"s must be {len(self.value)} finite numbers, is {s}")
        if not 0.0 <= dt < math.inf:
            raise ValueError(f"dt must be a finite number >= 0, is {dt}")
        decay, gain = leak_factors(self._theta, dt, paper_form=False)
        self.value = decay * self.value + gain * (s - self._s_last)
        self._s_last = s
        return self.value.copy()
