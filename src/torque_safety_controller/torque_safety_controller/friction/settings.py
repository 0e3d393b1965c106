# SPDX-License-Identifier: Apache-2.0
"""Friction model and settings of the friction compensation, checked in one place."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from viability_bounds_pkg.exceptions import SettingError

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

    Raises:
        SettingError: a value is out of range, or the shapes differ.
    """

    coulomb: NDArray[np.float64]
    static: NDArray[np.float64]
    viscous: NDArray[np.float64]
    stribeck_velocity: NDArray[np.float64]

    def __post_init__(self) -> None:
        n = np.size(self.coulomb)
        for name in COEFFICIENTS:
            value = _finite_vector(name, getattr(self, name), n)
            if not (value >= 0.0).all():
                raise SettingError(name, value, "numbers >= 0")
            object.__setattr__(self, name, value)
        if not (self.static >= self.coulomb).all():
            raise SettingError("static", self.static, "at least coulomb everywhere")
        if not (self.stribeck_velocity > 0.0).all():
            raise SettingError("stribeck_velocity", self.stribeck_velocity, "numbers > 0")

    @property
    def n(self) -> int:
        """Number of joints."""
        return self.coulomb.size

    def level(self, v: ArrayLike) -> NDArray[np.float64]:
        """Return F(v), N m, for velocities of shape (..., n), rad/s."""
        v = np.asarray(v, dtype=np.float64)
        dry = np.exp(-((v / self.stribeck_velocity) ** 2)) * (self.static - self.coulomb)
        level: NDArray[np.float64] = self.coulomb + dry + self.viscous * np.abs(v)
        return level


def no_friction(n: int) -> FrictionModel:
    """Return the model of n joints without friction."""
    zero = np.zeros(n)
    return FrictionModel(zero, zero, zero, np.full(n, DEFAULT_STRIBECK_VELOCITY))


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

    Raises:
        SettingError: a value is out of range.
    """

    model: FrictionModel
    budget: NDArray[np.float64]
    scale: float = 0.0
    leak_rate: float = LEAK_RATE
    gain: float | None = None

    def __post_init__(self) -> None:
        budget = _finite_vector("budget", self.budget, self.model.n)
        if not (budget >= 0.0).all():
            raise SettingError("budget", budget, "numbers >= 0")
        object.__setattr__(self, "budget", budget)
        if not 0.0 <= self.scale <= 1.0:
            raise SettingError("scale", self.scale, "a number from 0 to 1")
        if not (math.isfinite(self.leak_rate) and self.leak_rate >= 0.0):
            raise SettingError("leak_rate", self.leak_rate, "a finite number >= 0")
        if self.gain is not None and not (math.isfinite(self.gain) and self.gain > 0.0):
            raise SettingError("gain", self.gain, "a finite number > 0")


def _finite_vector(name: str, value: ArrayLike, n: int) -> NDArray[np.float64]:
    """Return n finite numbers as a read-only copy."""
    vector = np.array(value, dtype=np.float64)
    if vector.shape != (n,) or n == 0 or not np.isfinite(vector).all():
        raise SettingError(name, value, f"{n} finite numbers, one for each joint")
    vector.flags.writeable = False
    return vector
