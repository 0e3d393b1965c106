# SPDX-License-Identifier: Apache-2.0
"""Parameters of the integral action."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from torque_safety_controller.integral_action import MODES, TASKS
from torque_safety_controller.integral_feedback.settings import METHODS, IntegralSettings
from viability_bounds_pkg.exceptions import SettingError
from viability_bounds_pkg.parameter import (
    NOT_NEGATIVE,
    Range,
    joint_numbers,
    number,
    numbers,
    text,
)

Array = NDArray[np.float64]

BUDGET = 0.1
"""Default budget in torque limits: the paper's tau_m."""


@dataclass(frozen=True, eq=False, kw_only=True)
class IntegralConfiguration:
    """Parameters of the integral action."""

    integral_action: str = text(
        "none; joints: all joints stiff; task, position: the end effector's pose, or its "
        "position, stiff and the null space compliant",
        default="none",
        live=True,
        choices=MODES,
    )
    integral_budget: Array = joint_numbers(
        f"limits of the additional torque, N m; {BUDGET:g} of torque_max if empty",
        NOT_NEGATIVE,
        default=(),
        live=True,
        note="at most torque_max",
    )
    integral_lambda: float = number(
        "gain, K = lambda diag(M), 1/s; less is used in postures where it would be unstable",
        Range(1.0, 1e3),
        default=2.0,
        live=True,
    )
    integral_leak: Array = numbers(
        "leak rates theta_s and theta_f of the slow and the fast integrator, 1/s, the share mu of "
        "the fast one, and, for task or position with qp, the leak rate theta_null in the null "
        "space, 1/s, theta_f if left out",
        NOT_NEGATIVE,
        default=(0.1, 100.0, 0.5),
        live=True,
        note="[theta_s, theta_f, mu] or [theta_s, theta_f, mu, theta_null] with theta_f >= "
        "theta_s, mu <= 1 and theta_null >= theta_s",
    )
    integral_anti_windup: str = text(
        "qp limits the whole torque and the integrators; paper and scaling limit the torque of "
        "the gains only, by eq. (11) and (10), and the law is as printed, that of task and "
        "position with (16), (21) and (26)",
        default="qp",
        live=True,
        choices=METHODS,
    )

    def settings(self, tau_max: Array, hands: int = 1) -> IntegralSettings:
        """Return the settings of the integral action.

        Args:
            tau_max: torque limits, shape (n,), N m.
            hands: number of end effectors.

        Raises:
            SettingError: values that do not fit together.
        """
        rows = TASKS.get(self.integral_action)
        if rows is not None and hands * rows.stop >= len(tau_max):
            allowed = (
                f"'none' or 'joints': {len(tau_max)} joints have no null space left of the task"
            )
            raise SettingError("integral_action", self.integral_action, allowed)
        budget = self.integral_budget if len(self.integral_budget) else BUDGET * tau_max
        if (budget > tau_max).any():
            raise SettingError("integral_budget", budget, "at most torque_max")
        if len(self.integral_leak) not in (3, 4):
            raise SettingError("integral_leak", self.integral_leak, "3 or 4 finite numbers")
        slow, fast, mu, *null = self.integral_leak.tolist()
        if fast < slow or mu > 1.0 or min(null, default=slow) < slow:
            allowed = "theta_f >= theta_s, mu <= 1 and theta_null >= theta_s"
            raise SettingError("integral_leak", self.integral_leak, allowed)
        return IntegralSettings(
            budget,
            gain=self.integral_lambda,
            slow_leak_rate=slow,
            fast_leak_rate=fast,
            mu=mu,
            anti_windup=self.integral_anti_windup,
            null_leak_rate=null[0] if null else None,
        )
