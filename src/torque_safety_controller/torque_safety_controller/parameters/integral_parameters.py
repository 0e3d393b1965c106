# SPDX-License-Identifier: Apache-2.0
"""Parameters of the integral action: the table, and the settings made of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torque_safety_controller.additional_torque import MODES, AdditionalSettings
from torque_safety_controller.integral_feedback.settings import (
    METHODS,
    IntegralSettings,
)
from torque_safety_controller.parameters.friction_parameters import friction_settings
from viability_bounds_pkg.exceptions import SettingError
from viability_bounds_pkg.ros.parameters import (
    NOT_NEGATIVE,
    Parameter,
    above,
    given_or,
)

Array = NDArray[np.float64]

BUDGET = 0.1
"""Default budget in torque limits: the paper's tau_m."""

DISTURBANCE_MAX = 2.0
"""Disturbances beyond this many torque limits are not integrated."""

TASKS = {"pose": slice(0, 6), "position": slice(0, 3)}
"""Rows of the pose's Jacobian that are a task of integral action ``task``."""

INTEGRAL_TABLE = (
    Parameter(
        "integral_action",
        str,
        "none; joints: all joints stiff; task: the task stiff and its null space compliant",
        default="none",
        live=True,
        choices=MODES,
    ),
    Parameter(
        "integral_budget",
        list[float],
        f"limits of the additional torque, N m; {BUDGET:g} of torque_max if empty",
        default=np.zeros(0),
        live=True,
        per_joint=True,
        within=NOT_NEGATIVE,
        note="at most torque_max",
    ),
    Parameter(
        "integral_lambda",
        float,
        "gain, K = lambda diag(M), 1/s",
        default=2.0,
        live=True,
        within=above(0.0, 1e3),
    ),
    Parameter(
        "integral_leak",
        list[float],
        "leak rates theta_s and theta_f of the slow and the fast integrator, 1/s, and the share "
        "mu of the fast one",
        default=(0.1, 100.0, 0.5),
        live=True,
        length=3,
        within=NOT_NEGATIVE,
        note="[theta_s, theta_f, mu] with theta_f >= theta_s and mu <= 1",
    ),
    Parameter(
        "integral_anti_windup",
        str,
        "for joints: qp limits the whole torque and the integrators; paper and scaling limit K s "
        "only, by eq. (11) and (10) as printed; none limits nothing",
        default="qp",
        live=True,
        choices=METHODS,
    ),
    Parameter(
        "integral_task",
        str,
        "for task: what of the end effector is stiff",
        default="pose",
        choices=tuple(TASKS),
    ),
)


def additional_settings(
    values: Mapping[str, Any], joints: Sequence[str], tau_max: Array
) -> AdditionalSettings:
    """Return the settings of the additional torque.

    Args:
        values: parameter values by name.
        joints: names of the n joints.
        tau_max: torque limits, shape (n,), N m.

    Raises:
        SettingError: values that do not fit together.
    """
    mode = values["integral_action"]
    if mode == "task" and task_rows(values).stop >= len(joints):
        allowed = f"'none' or 'joints': {len(joints)} joints have no null space left of the task"
        raise SettingError("integral_action", mode, allowed)
    budget = given_or(values, "integral_budget", BUDGET * tau_max)
    if (budget > tau_max).any():
        raise SettingError("integral_budget", budget, "at most torque_max")
    slow, fast, mu = leak = values["integral_leak"]
    if fast < slow or mu > 1.0:
        raise SettingError("integral_leak", leak, "theta_f >= theta_s and mu <= 1")
    integral = IntegralSettings(
        budget,
        gain=values["integral_lambda"],
        slow_leak_rate=slow,
        fast_leak_rate=fast,
        mu=mu,
        anti_windup=values["integral_anti_windup"],
    )
    friction = friction_settings(values, tau_max)
    return AdditionalSettings(mode, integral, DISTURBANCE_MAX * tau_max, friction)


def task_rows(values: Mapping[str, Any]) -> slice:
    """Return which rows of the pose's Jacobian ``integral_task`` names."""
    return TASKS[values["integral_task"]]
