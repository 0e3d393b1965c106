# SPDX-License-Identifier: Apache-2.0
"""Parameters of the friction compensation: the table, and the settings made of them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torque_safety_controller.friction.settings import (
    DEFAULT_STRIBECK_VELOCITY,
    FrictionModel,
    FrictionSettings,
)
from viability_bounds_pkg.exceptions import SettingError
from viability_bounds_pkg.ros.parameters import (
    NOT_NEGATIVE,
    POSITIVE,
    Parameter,
    Range,
    given_or,
)

Array = NDArray[np.float64]

BUDGET = 0.2
"""Largest torque that is compensated, in torque limits."""

MODEL = {
    "coulomb": "dry friction of moving joints, N m; none if empty",
    "static": "dry friction of joints at rest, N m; that of moving ones if empty",
    "viscous": "friction that grows with speed, N m s/rad; none if empty",
    "stribeck_velocity": "speed at which static has become Coulomb friction but for 1/e of the "
    f"difference, rad/s; {DEFAULT_STRIBECK_VELOCITY:g} if empty",
}
"""Friction model of each joint; `identify_friction` finds it."""

FRICTION_TABLE = (
    Parameter(
        "friction_compensation",
        float,
        "share of the friction model that is compensated; 0: off",
        default=0.0,
        live=True,
        within=Range(0.0, 1.0),
    ),
    *(
        Parameter(
            f"friction_model_{name}",
            list[float],
            text,
            default=np.zeros(0),
            live=True,
            per_joint=True,
            within=POSITIVE if name == "stribeck_velocity" else NOT_NEGATIVE,
        )
        for name, text in MODEL.items()
    ),
)


def friction_settings(values: Mapping[str, Any], tau_max: Array) -> FrictionSettings:
    """Return the settings of the friction compensation.

    Args:
        values: parameter values by name.
        tau_max: torque limits, shape (n,), N m.

    Raises:
        SettingError: values that do not fit together.
    """
    scale = values["friction_compensation"]
    names = [f"friction_model_{name}" for name in ("coulomb", "static", "viscous")]
    if scale > 0.0 and not any(len(values[name]) for name in names):
        allowed = "0 as long as no friction_model_coulomb, _static or _viscous is given"
        raise SettingError("friction_compensation", scale, allowed)
    zero = np.zeros_like(tau_max)
    coulomb = given_or(values, "friction_model_coulomb", zero)
    static = given_or(values, "friction_model_static", coulomb)
    if (static < coulomb).any():
        allowed = "at least friction_model_coulomb everywhere"
        raise SettingError("friction_model_static", static, allowed)
    viscous = given_or(values, "friction_model_viscous", zero)
    speed = zero + DEFAULT_STRIBECK_VELOCITY
    speed = given_or(values, "friction_model_stribeck_velocity", speed)
    model = FrictionModel(coulomb, static, viscous, speed)
    return FrictionSettings(model, BUDGET * tau_max, scale)
