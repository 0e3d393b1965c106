# SPDX-License-Identifier: Apache-2.0
"""Friction compensation in the direction in which the joint is wanted to go.

[Benallegue2021] names it as the next step. With the friction of a moving joint at most F(v), in
`friction/settings.py`, and a reference velocity w that integrates the acceleration asked for,

    w' = a_ref - theta (w - v),
    tau_f = clip(gamma m w, -k F(v), k F(v)),    m = 1 / (M^-1)_ii,

with k the share to compensate, and m the inertia that the joint's motor feels. A joint that moves
as it should has w = v, and its friction is compensated; one at rest has w ~ a_ref / theta: the
acceleration wanted decides the direction, and takes it out of its stiction. `docs/friction.md`
derives the law, and what keeps it from driving the joint: of the friction itself it never takes
more than there is, and of too large a model it makes a stiffer spring.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torque_safety_controller.friction.settings import GAIN, FrictionSettings
from viability_bounds_pkg.compiled import compiled

Array = NDArray[np.float64]

_FADING_TIME = 0.2  # s; in which new coefficients take the place of old ones
_NEGLIGIBLE = 1e-9  # N m


class _Coefficients(NamedTuple):
    """Friction that is compensated, shape (n,) each; see `FrictionModel`, `FrictionSettings`."""

    coulomb: Array
    excess: Array
    """Static friction beyond Coulomb friction."""
    viscous: Array
    stribeck_velocity: Array
    budget: Array


class FrictionCompensation:
    """Friction compensation of one arm.

    Args:
        settings: may be replaced between steps: the torque does not jump.

    Attributes:
        last: what the last step compensated, shape (n,), N m; overwritten by the next.
        reference_velocity: w, shape (n,), rad/s; overwritten by the next step.
    """

    def __init__(self, settings: FrictionSettings) -> None:
        n = settings.model.n
        self.last = np.zeros(n)
        self.reference_velocity = np.zeros(n)
        self._settings = settings
        self._wanted = _coefficients(settings)
        self._present = _Coefficients(*(x.copy() for x in self._wanted))
        self.reset()
        # The first call compiles; let it be this one and not one in a control loop.
        self._step(np.eye(n), np.zeros(n), np.zeros(n), 0.0, 1.0)

    @property
    def settings(self) -> FrictionSettings:
        """Settings; their coefficients take the place of the old ones little by little."""
        return self._settings

    @settings.setter
    def settings(self, settings: FrictionSettings) -> None:
        self._settings = settings
        self._wanted = _coefficients(settings)

    @property
    def idle(self) -> bool:
        """Whether nothing is compensated."""
        return self._settings.scale == 0.0 and self._faded

    def reset(self) -> None:
        """Forget the past: the compensation begins with nothing and fades in."""
        for present, wanted in zip(self._present, self._wanted, strict=True):
            present[:] = wanted
        for present in (self._present.coulomb, self._present.excess, self._present.viscous):
            present.fill(0.0)
        self._faded = True
        self._started = False
        self.last.fill(0.0)

    def torque(self, M: Array, v: Array, a_last: Array, elapsed: float, period: float) -> Array:
        """Return the compensating torque of a control step, shape (n,), N m.

        It is never beyond the budget, and finite for finite arguments.

        Args:
            M: mass matrix, shape (n, n), kg m^2.
            v: velocity, shape (n,), rad/s.
            a_last: acceleration commanded in the last step, shape (n,), rad/s^2.
            elapsed: time since the last step, s; 0 where it is not known: then the reference
                velocity stays what it is.
            period: control period, s.
        """
        if self.idle:
            self._started = False
            self.last.fill(0.0)
            return self.last
        if not self._started:
            if self._faded:
                self.reset()
            self.reference_velocity[:] = v
            self._started = True
        try:
            self._step(M, v, a_last, elapsed, period)
        except np.linalg.LinAlgError:  # no mass matrix
            self.reference_velocity.fill(0.0)
            self.last.fill(0.0)
        return self.last

    def _step(self, M: Array, v: Array, a_last: Array, elapsed: float, period: float) -> None:
        settings = self._settings
        self._faded = _compensate(
            *self._present,
            *self._wanted,
            -math.expm1(-elapsed / _FADING_TIME),
            M,
            v,
            a_last,
            elapsed,
            float(settings.leak_rate),
            GAIN / period if settings.gain is None else float(settings.gain),
            self.reference_velocity,
            self.last,
        )


def _coefficients(settings: FrictionSettings) -> _Coefficients:
    """Return what the kernel evaluates: the share is in the model."""
    model, scale = settings.model, settings.scale
    return _Coefficients(
        scale * model.coulomb,
        scale * (model.static - model.coulomb),
        scale * model.viscous,
        model.stribeck_velocity.copy(),
        settings.budget.copy(),
    )


@compiled
def _compensate(
    coulomb: Array,
    excess: Array,
    viscous: Array,
    stribeck_velocity: Array,
    budget: Array,
    coulomb_wanted: Array,
    excess_wanted: Array,
    viscous_wanted: Array,
    stribeck_velocity_wanted: Array,
    budget_wanted: Array,
    blend: float,
    M: Array,
    v: Array,
    a_last: Array,
    dt: float,
    leak_rate: float,
    gamma: float,
    w: Array,
    tau: Array,
) -> bool:
    """Make a step in the coefficients, `w` and `tau`; return whether no friction is left in them.

    The first arguments are the fields of two `_Coefficients`: Numba takes microseconds to unpack
    named tuples that come from Python. The reference velocity is that of constant acceleration
    and velocity within the step.
    """
    coulomb += blend * (coulomb_wanted - coulomb)
    excess += blend * (excess_wanted - excess)
    viscous += blend * (viscous_wanted - viscous)
    stribeck_velocity += blend * (stribeck_velocity_wanted - stribeck_velocity)
    budget += blend * (budget_wanted - budget)
    decay = math.exp(-leak_rate * dt)
    held = -math.expm1(-leak_rate * dt) / (leak_rate * dt) if leak_rate * dt > 0.0 else 1.0
    gain = gamma / np.diag(np.linalg.inv(M))  # of the inertia felt while others give way
    largest = 0.0
    for i in range(len(v)):
        speed = abs(v[i])
        stiction = excess[i] * math.exp(-((speed / stribeck_velocity[i]) ** 2))
        friction = coulomb[i] + stiction + viscous[i] * speed
        friction = min(friction, budget[i])
        # More than what calls for all of the friction is nothing to remember.
        enough = friction / gain[i]
        w_new = decay * w[i] + (1.0 - decay) * v[i] + held * dt * a_last[i]
        w[i] = min(max(w_new, min(v[i], 0.0) - enough), max(v[i], 0.0) + enough)
        tau[i] = min(max(gain[i] * w[i], -friction), friction)
        if not math.isfinite(tau[i] + w[i]):
            w[i] = tau[i] = 0.0
        largest = max(largest, coulomb[i] + excess[i] + viscous[i])
    return largest < _NEGLIGIBLE
