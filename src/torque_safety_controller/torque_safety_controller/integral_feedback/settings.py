# SPDX-License-Identifier: Apache-2.0
"""Modes and settings of the integral action, checked in one place."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from viability_bounds_pkg.exceptions import SettingError

Array = NDArray[np.float64]

TASKS = {"task": slice(0, 6), "position": slice(0, 3)}
"""Rows of the pose's Jacobian that are stiff in each mode that has a null space."""

MODES = ("none", "joints", *TASKS)

METHODS = ("qp", "paper", "scaling")
"""Anti-windup: of the whole torque, integrators included; or (11) or (10) as [Benallegue2021]
prints them, that is for the torque of the gains only, with the integrators left alone, (13), and
in mode ``task`` with (16), (21) and (26) as printed."""


@dataclass(frozen=True, eq=False)
class IntegralSettings:
    """Settings of an integral action; gain, rates and mu are by default the paper's, IV-A.

    Attributes:
        budget: limit of the additional torque of each joint, tau_m, shape (n,), N m, >= 0; inf
            for none. Given for one joint or more; kept as a read-only copy.
        gain: lambda of K = lambda diag(M), 1/s, > 0.
        slow_leak_rate: theta_s, 1/s, >= 0; 0 never forgets.
        fast_leak_rate: theta_f, 1/s, >= theta_s.
        mu: weight of the fast integrator, 0 to 1, eq. (14).
        anti_windup: one of `METHODS`.

    Raises:
        SettingError: a value is out of range.
    """

    budget: Array
    gain: float = 2.0
    slow_leak_rate: float = 0.1
    fast_leak_rate: float = 100.0
    mu: float = 0.5
    anti_windup: str = "qp"

    def __post_init__(self) -> None:
        budget = np.array(self.budget, dtype=np.float64)
        if budget.ndim != 1 or len(budget) == 0 or not (budget >= 0.0).all():
            raise SettingError("budget", self.budget, "a number >= 0 for each joint")
        budget.flags.writeable = False
        object.__setattr__(self, "budget", budget)
        if not 0.0 < self.gain < math.inf:
            raise SettingError("gain", self.gain, "a finite number > 0")
        slow = self.slow_leak_rate
        if not 0.0 <= slow < math.inf:
            raise SettingError("slow_leak_rate", slow, "a finite number >= 0")
        fast = self.fast_leak_rate
        if not slow <= fast < math.inf:
            raise SettingError("fast_leak_rate", fast, f"a finite number >= the slow one, {slow}")
        if not 0.0 <= self.mu <= 1.0:
            raise SettingError("mu", self.mu, "a number from 0 to 1")
        if self.anti_windup not in METHODS:
            raise SettingError("anti_windup", self.anti_windup, " or ".join(METHODS))

    @property
    def as_printed(self) -> bool:
        """Whether the law is the paper's to the letter."""
        return self.anti_windup != "qp"

    def same_as(self, other: IntegralSettings) -> bool:
        """Return whether all values are those of `other`."""
        names = (field.name for field in fields(self))
        return all(np.array_equal(getattr(self, name), getattr(other, name)) for name in names)
