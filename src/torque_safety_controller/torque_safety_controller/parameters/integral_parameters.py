"""Parameters of the integral action: the table, and the settings made of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from torque_safety_controller.additional_torque import MODES, AdditionalSettings
from torque_safety_controller.integral_feedback.settings import (
    METHODS,
    IntegralSettings,
)
from torque_safety_controller.parameters.friction_parameters import friction_settings
from viability_bounds_pkg.exceptions import SettingError
from viability_bounds_pkg.ros.parameters import Parameter, per_joint

BUDGET = 0.1
"""Default budget in torque limits: the paper's tau_m."""

DISTURBANCE_MAX = 2.0
"""Disturbances beyond this many torque limits are not integrated."""

TASKS = {"pose": slice(0, 6), "position": slice(0, 3)}
"""Rows of the pose's Jacobian that are a task of integral action ``task``."""

TABLE = (
    Parameter(
        "integral_action",
        str,
        f"one of {', '.join(MODES)}: none; all joints stiff; or the task stiff and its null "
        "space compliant",
        default="none",
        live=True,
    ),
    Parameter(
        "integral_budget",
        list[float],
        f"limits of the additional torque, N m; {BUDGET:g} of torque_max if empty",
        default=np.zeros(0),
        live=True,
    ),
    Parameter("integral_lambda", float, "gain, K = lambda diag(M), 1/s", default=2.0, live=True),
    Parameter(
        "integral_theta_slow", float, "rate of slow forgetting, 1/s", default=0.1, live=True
    ),
    Parameter(
        "integral_theta_fast", float, "rate of fast forgetting, 1/s", default=100.0, live=True
    ),
    Parameter("integral_mu", float, "share of the fast memory, 0 to 1", default=0.5, live=True),
    Parameter(
        "integral_anti_windup",
        str,
        f"for joints: one of {', '.join(METHODS)}; qp limits the whole torque and the "
        "integrators; scaling is eq. (10) and paper (11) as printed, for K s only",
        default="qp",
        live=True,
    ),
    Parameter(
        "integral_task",
        str,
        f"for task: one of {', '.join(TASKS)}; what is stiff of the end effector",
        default="pose",
    ),
)

_NAME_OF = {"gain": "lambda", "slow_leak_rate": "theta_slow", "fast_leak_rate": "theta_fast"}


def additional_settings(
    values: Mapping[str, Any], joints: Sequence[str], tau_max: np.ndarray
) -> AdditionalSettings:
    """Return the settings of the additional torque.

    Args:
        values: parameter values by name.
        joints: names of the n joints.
        tau_max: torque limits, shape (n,), N m.

    Raises:
        SettingError: a value cannot be used.
    """
    mode = values["integral_action"]
    if mode not in MODES:
        raise SettingError("integral_action", mode, f"one of {', '.join(MODES)}")
    rows = task_rows(values)
    if mode == "task" and rows.stop >= len(joints):
        allowed = f"'none' or 'joints': {len(joints)} joints have no null space left of the task"
        raise SettingError("integral_action", mode, allowed)
    budget = BUDGET * tau_max
    if len(values["integral_budget"]):
        budget = per_joint(values, "integral_budget", joints)
        if (budget > tau_max).any():
            raise SettingError("integral_budget", budget, "at most torque_max")
    try:
        integral = IntegralSettings(
            budget,
            gain=values["integral_lambda"],
            slow_leak_rate=values["integral_theta_slow"],
            fast_leak_rate=values["integral_theta_fast"],
            mu=values["integral_mu"],
            anti_windup=values["integral_anti_windup"],
        )
    except SettingError as error:
        name = f"integral_{_NAME_OF.get(error.name, error.name)}"
        raise SettingError(name, error.value, error.allowed) from error
    friction = friction_settings(values, joints, tau_max)
    return AdditionalSettings(mode, integral, DISTURBANCE_MAX * tau_max, friction)


def task_rows(values: Mapping[str, Any]) -> slice:
    """Return which rows of the pose's Jacobian ``integral_task`` names.

    Raises:
        SettingError: it is unknown.
    """
    task = values["integral_task"]
    if task not in TASKS:
        raise SettingError("integral_task", task, f"one of {', '.join(TASKS)}")
    return TASKS[task]
