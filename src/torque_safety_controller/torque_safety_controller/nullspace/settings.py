"""What null-space compliance can be set to, checked in one place."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from torque_safety_controller.linalg.generalized_inverse import THRESHOLD
from viability_bounds_pkg.exceptions import SettingError


@dataclass(frozen=True, eq=False)
class NullspaceSettings:
    """Settings of `NullspaceCompliance`; rates, gain and share are the paper's, IV-A.

    Attributes:
        budget: limit of the additional torque of each joint, shape (n,), N m, >= 0; inf for
            none. Kept as a read-only copy.
        lambda_: gain, 1/s, > 0; K = lambda_ diag(M).
        theta_slow: rate at which the task's error is forgotten, 1/s, >= 0; 0 never.
        theta_fast: rate of the fast memory, 1/s, >= theta_slow.
        mu: share of the fast memory, 0 to 1.
        theta_null: rate at which the null space is forgotten, 1/s, >= theta_slow; None for
            `theta_fast` where the null space is free, else for `theta_slow`.
        free_null_space: whether the slow memory acts in the task only, eq. (26); else
            everywhere, K a of eq. (21).
        dynamically_consistent: which generalised inverse; False for the pseudo-inverse.
        keep_integral: whether integral(J' s) is kept from the start, as printed. By default the
            memory is a alone, which gives the same eq. (23) and (25), and cannot grow.
        threshold: singular value of J below which its direction is damped, > 0.
        blend_time: time constant with which that part of the torque of the mode before fades
            that has no place in this one, s, > 0.
        widening_time: time constant with which a budget that `seed` widened returns to what it
            should be, s, > 0.

    Raises:
        SettingError: a value is out of range.
    """

    budget: NDArray[np.float64]
    lambda_: float = 2.0
    theta_slow: float = 0.1
    theta_fast: float = 100.0
    mu: float = 0.5
    theta_null: float | None = None
    free_null_space: bool = True
    dynamically_consistent: bool = True
    keep_integral: bool = False
    threshold: float = THRESHOLD
    blend_time: float = 0.2
    widening_time: float = 1.0

    def __post_init__(self) -> None:
        budget = np.array(self.budget, dtype=np.float64)
        if budget.ndim != 1 or len(budget) == 0 or not (budget >= 0.0).all():
            raise SettingError("budget", self.budget, "a number >= 0 for each joint")
        budget.flags.writeable = False
        object.__setattr__(self, "budget", budget)
        if not (math.isfinite(self.theta_slow) and self.theta_slow >= 0.0):
            raise SettingError("theta_slow", self.theta_slow, "a finite number >= 0")
        for name in ("theta_fast", "theta_null"):
            value = getattr(self, name)
            if value is None and name == "theta_null":
                continue
            if not (math.isfinite(value) and value >= self.theta_slow):
                raise SettingError(
                    name, value, f"a finite number >= theta_slow = {self.theta_slow}"
                )
        for name in ("lambda_", "threshold", "blend_time", "widening_time"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise SettingError(name, value, "a finite number > 0")
        if not 0.0 <= self.mu <= 1.0:
            raise SettingError("mu", self.mu, "a number from 0 to 1")

    @property
    def null_rate(self) -> float:
        """`theta_null`, or what stands for it, 1/s."""
        if self.theta_null is not None:
            return self.theta_null
        return self.theta_fast if self.free_null_space else self.theta_slow
