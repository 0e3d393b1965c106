# SPDX-License-Identifier: Apache-2.0
"""Parameters of the friction compensation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from torque_safety_controller.friction.settings import (
    DEFAULT_STRIBECK_VELOCITY,
    FrictionModel,
    FrictionSettings,
)
from viability_bounds_pkg.exceptions import SettingError
from viability_bounds_pkg.parameter import (
    NOT_NEGATIVE,
    POSITIVE,
    Range,
    joint_numbers,
    number,
)

Array = NDArray[np.float64]

BUDGET = 0.2
"""Largest torque that is compensated, in torque limits."""


@dataclass(frozen=True, eq=False, kw_only=True)
class FrictionConfiguration:
    """Parameters of the friction compensation; `identify_friction` finds the model."""

    friction_compensation: float = number(
        "share of the friction model that is compensated; 0: off",
        Range(0.0, 1.0),
        default=0.0,
        live=True,
    )
    friction_model_coulomb: Array = joint_numbers(
        "dry friction of moving joints, N m; none if empty", NOT_NEGATIVE, default=(), live=True
    )
    friction_model_static: Array = joint_numbers(
        "dry friction of joints at rest, N m; that of moving ones if empty",
        NOT_NEGATIVE,
        default=(),
        live=True,
    )
    friction_model_viscous: Array = joint_numbers(
        "friction that grows with speed, N m s/rad; none if empty",
        NOT_NEGATIVE,
        default=(),
        live=True,
    )
    friction_model_stribeck_velocity: Array = joint_numbers(
        "speed at which static has become Coulomb friction but for 1/e of the difference, rad/s; "
        f"{DEFAULT_STRIBECK_VELOCITY:g} if empty",
        POSITIVE,
        if_empty=DEFAULT_STRIBECK_VELOCITY,
        live=True,
    )

    def settings(self, tau_max: Array) -> FrictionSettings:
        """Return the settings of the friction compensation.

        Args:
            tau_max: torque limits, shape (n,), N m.

        Raises:
            SettingError: values that do not fit together.
        """
        given = (
            self.friction_model_coulomb,
            self.friction_model_static,
            self.friction_model_viscous,
        )
        scale = self.friction_compensation
        if scale > 0.0 and not any(map(len, given)):
            allowed = "0 as long as no friction_model_coulomb, _static or _viscous is given"
            raise SettingError("friction_compensation", scale, allowed)
        coulomb, static, viscous = (row if len(row) else 0.0 * tau_max for row in given)
        if not len(self.friction_model_static):
            static = coulomb
        if (static < coulomb).any():
            allowed = "at least friction_model_coulomb everywhere"
            raise SettingError("friction_model_static", static, allowed)
        model = FrictionModel(coulomb, static, viscous, self.friction_model_stribeck_velocity)
        return FrictionSettings(model, BUDGET * tau_max, scale)
