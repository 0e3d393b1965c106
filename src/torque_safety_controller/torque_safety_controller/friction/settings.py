# SPDX-License-Identifier: Apache-2.0
"""Friction model, and settings of the friction compensation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

COEFFICIENTS = ("coulomb", "static", "viscous", "stribeck_velocity")
"""Names of the coefficients of `FrictionModel`, in order."""

DEFAULT_STRIBECK_VELOCITY = 0.01
"""rad/s."""

LEAK_RATE = 3.0
"""theta: rate at which the reference velocity returns to the measured one, 1/s, by default."""

GAIN = 0.1
"""gamma in control rates, by default: how soon the reference velocity calls for all friction."""


@dataclass(frozen=True, eq=False)
class FrictionModel:
    """Friction of n joints: f(v) = sign(v) F(v), and at rest whatever holds, up to F(0).

        F(v) = F_c + (F_s - F_c) exp(-(v / v_s)^2) + d |v|

    Attributes:
        coulomb: F_c, dry friction of a moving joint, shape (n,), N m, >= 0.
        static: F_s, that of a joint at rest, shape (n,), N m, >= coulomb.
        viscous: d, shape (n,), N m s/rad, >= 0.
        stribeck_velocity: v_s between the two, shape (n,), rad/s, > 0.
    """

    coulomb: Array
    static: Array
    viscous: Array
    stribeck_velocity: Array

    def level(self, v: ArrayLike) -> Array:
        """Return F(v), N m, for velocities of shape (..., n), rad/s."""
        v = np.asarray(v, dtype=np.float64)
        dry = np.exp(-((v / self.stribeck_velocity) ** 2)) * (self.static - self.coulomb)
        level: Array = self.coulomb + dry + self.viscous * np.abs(v)
        return level


@dataclass(frozen=True, eq=False)
class FrictionSettings:
    """Settings of `parts.friction.Friction`.

    Attributes:
        model: of the joints' friction.
        budget: most that is ever compensated, whatever the model says, shape (n,), N m, >= 0.
        scale: share of the model that is compensated, 0 to 1; 0 is off.
        leak_rate: theta, rate at which the reference velocity returns to the measured one, 1/s,
            >= 0.
        gain: gamma of the reference velocity, in torques for the inertia felt, 1/s, > 0; None
            for `GAIN` times the control rate.
    """

    model: FrictionModel
    budget: Array
    scale: float = 0.0
    leak_rate: float = LEAK_RATE
    gain: float | None = None
