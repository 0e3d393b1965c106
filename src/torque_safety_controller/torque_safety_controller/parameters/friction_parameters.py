"""Parameters of the friction compensation: the table, and the settings made of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from torque_safety_controller.friction.settings import (
    DEFAULT_STRIBECK_VELOCITY,
    FrictionModel,
    FrictionSettings,
)
from viability_bounds_pkg.exceptions import SettingError
from viability_bounds_pkg.ros.parameters import Parameter, per_joint

BUDGET = 0.2
"""Most that is compensated, in torque limits."""

MODEL = {
    "coulomb": "dry friction of moving joints, N m",
    "static": "dry friction of joints at rest, N m; that of moving ones if empty",
    "viscous": "friction that grows with speed, N m s/rad; none if empty",
    "stribeck_velocity": "speed at which static has become Coulomb friction but for 1/e of the "
    f"difference, rad/s; {DEFAULT_STRIBECK_VELOCITY:g} if empty",
}
"""What the controller believes of each joint's friction; `identify_friction` finds it."""

TABLE = (
    Parameter(
        "friction_compensation",
        float,
        "share of the friction model that is compensated, 0 (off) to 1",
        default=0.0,
        live=True,
    ),
    *(
        Parameter(f"friction_model_{name}", list[float], text, default=np.zeros(0), live=True)
        for name, text in MODEL.items()
    ),
)


def friction_settings(
    values: Mapping[str, Any], joints: Sequence[str], tau_max: np.ndarray
) -> FrictionSettings:
    """Return the settings of the friction compensation.

    Args:
        values: parameter values by name.
        joints: names of the n joints.
        tau_max: torque limits, shape (n,), N m.

    Raises:
        SettingError: a value cannot be used.
    """
    n = len(joints)
    scale = values["friction_compensation"]
    defaults = {
        "coulomb": np.zeros(n),
        "viscous": np.zeros(n),
        "stribeck_velocity": np.full(n, DEFAULT_STRIBECK_VELOCITY),
    }
    given = {name: values[f"friction_model_{name}"] for name in MODEL}
    if scale > 0.0 and not any(len(given[name]) for name in ("coulomb", "static", "viscous")):
        allowed = "0 as long as no friction_model_coulomb, _static or _viscous is given"
        raise SettingError("friction_compensation", scale, allowed)
    found = {
        name: per_joint(values, f"friction_model_{name}", joints)
        if len(value)
        else defaults.get(name)
        for name, value in given.items()
    }
    if found["static"] is None:
        found["static"] = found["coulomb"]
    try:
        model = FrictionModel(**found)
    except SettingError as error:
        name = f"friction_model_{error.name}"
        raise SettingError(name, error.value, error.allowed) from error
    try:
        return FrictionSettings(model, BUDGET * tau_max, scale)
    except SettingError as error:
        raise SettingError("friction_compensation", error.value, error.allowed) from error
