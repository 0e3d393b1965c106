"""What the integral action can be set to, checked in one place."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from viability_bounds_pkg.exceptions import SettingError

METHODS = ("none", "clip", "scaling", "qp")
"""Ways to limit the additional torque: not at all, component by component, (10), (11)."""


@dataclass(frozen=True, eq=False)
class IntegralSettings:
    """Settings of `IntegralFeedback`; the defaults of the rates are the paper's, IV-A.

    Attributes:
        budget: limit of the additional torque of each joint, tau_m, shape (n,), N m, >= 0; inf
            for none. Given for one joint or more; kept as a read-only copy.
        lambda_: gain, 1/s, > 0; K = lambda_ diag(M).
        theta_slow: rate of the slow forgetting, 1/s, >= 0; 0 never forgets.
        theta_fast: rate of the fast forgetting, 1/s, >= 0.
        mu: weight of the fast one, 0 to 1, eq. (14).
        anti_windup: one of `METHODS`.
        whole_torque: whether the budget is for all of the additional torque, (C + K) s; else,
            as in the paper, for K s alone.
        correct_state: whether the integrators are brought back to what the limited torque
            stands for, so that they leave the limit at once.
        paper_form: whether leaky integration is eq. (13) as printed; else the exact one.
        widening_time: time constant with which a budget that a handover widened returns to
            what it should be, s, > 0.

    Raises:
        SettingError: a value is out of range.
    """

    budget: NDArray[np.float64]
    lambda_: float = 2.0
    theta_slow: float = 0.1
    theta_fast: float = 100.0
    mu: float = 0.5
    anti_windup: str = "qp"
    whole_torque: bool = True
    correct_state: bool = True
    paper_form: bool = False
    widening_time: float = 1.0

    def __post_init__(self) -> None:
        budget = np.array(self.budget, dtype=np.float64)
        if budget.ndim != 1 or len(budget) == 0 or not (budget >= 0.0).all():
            raise SettingError("budget", self.budget, "a number >= 0 for each joint")
        budget.flags.writeable = False
        object.__setattr__(self, "budget", budget)
        for name in ("theta_slow", "theta_fast"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0.0):
                raise SettingError(name, value, "a finite number >= 0")
        for name in ("lambda_", "widening_time"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise SettingError(name, value, "a finite number > 0")
        if not 0.0 <= self.mu <= 1.0:
            raise SettingError("mu", self.mu, "a number from 0 to 1")
        if self.anti_windup not in METHODS:
            raise SettingError("anti_windup", self.anti_windup, " or ".join(METHODS))


def paper_settings(budget: ArrayLike) -> IntegralSettings:
    """Return the settings of [Benallegue2021] as printed: only K s limited, the state left alone.

    Args:
        budget: shape (n,), N m; the paper takes a tenth of the torque limits.
    """
    return IntegralSettings(
        np.asarray(budget), whole_torque=False, correct_state=False, paper_form=True
    )
