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

import numpy as np
from numpy.typing import NDArray

from torque_safety_controller.friction.settings import GAIN, FrictionSettings

Array = NDArray[np.float64]

_FADING_TIME = 0.2  # s; in which new coefficients take the place of old ones
_NEGLIGIBLE = 1e-9  # N m


class FrictionCompensation:
    """Friction compensation of one arm.

    Args:
        settings: may be replaced between steps: the torque does not jump.

    Attributes:
        settings: their coefficients take the place of the old ones little by little.
        last: what the last step compensated, shape (n,), N m.
        reference_velocity: w, shape (n,), rad/s.
    """

    def __init__(self, settings: FrictionSettings) -> None:
        self.settings = settings
        self.reset()

    @property
    def idle(self) -> bool:
        """Whether nothing is compensated."""
        return self.settings.scale == 0.0 and bool(
            (self._friction.sum(axis=0) < _NEGLIGIBLE).all()
        )

    def reset(self) -> None:
        """Forget the past: the compensation begins with nothing and fades in."""
        n = self.settings.model.n
        self._friction = np.zeros((3, n))  # of Coulomb, of stiction beyond it, and viscous
        self._others = np.array([self.settings.model.stribeck_velocity, self.settings.budget])
        self._faded, self._started = True, False
        self.last = self.reference_velocity = np.zeros(n)

    def torque(self, M: Array, v: Array, a_last: Array, elapsed: float, period: float) -> Array:
        """Return the compensating torque of a control step, shape (n,), N m.

        It is never beyond the budget, and finite for finite arguments. The reference velocity is
        that of constant acceleration and velocity within the step.

        Args:
            M: mass matrix, shape (n, n), kg m^2.
            v: velocity, shape (n,), rad/s.
            a_last: acceleration commanded in the last step, shape (n,), rad/s^2.
            elapsed: time since the last step, s; 0 where it is not known: then the reference
                velocity stays what it is.
            period: control period, s.
        """
        settings, model = self.settings, self.settings.model
        if self.idle:
            if self._started:
                self.reset()
            return self.last
        if not self._started:
            self.reference_velocity = v
            self._started = True
        blend = -math.expm1(-elapsed / _FADING_TIME)
        wanted = np.array([model.coulomb, model.static - model.coulomb, model.viscous])
        self._friction += blend * (settings.scale * wanted - self._friction)
        self._others += blend * ([model.stribeck_velocity, settings.budget] - self._others)
        self._faded = bool(self._friction.sum(axis=0).max() < _NEGLIGIBLE)
        (coulomb, excess, viscous), (stribeck_velocity, budget) = self._friction, self._others

        speed = np.abs(v)
        stiction = excess * np.exp(-((speed / stribeck_velocity) ** 2))
        friction = np.minimum(coulomb + stiction + viscous * speed, budget)
        try:
            felt = 1.0 / np.diagonal(np.linalg.inv(M))  # inertia while others give way
        except np.linalg.LinAlgError:  # no mass matrix
            felt = np.full_like(v, np.nan)
        gamma = GAIN / period if settings.gain is None else settings.gain
        gain = gamma * felt
        # More than what calls for all of the friction is nothing to remember.
        enough = friction / gain
        rate = settings.leak_rate * elapsed
        decay, held = math.exp(-rate), -math.expm1(-rate) / rate if rate > 0.0 else 1.0
        w = decay * self.reference_velocity + (1.0 - decay) * v + held * elapsed * a_last
        w = np.clip(w, np.minimum(v, 0.0) - enough, np.maximum(v, 0.0) + enough)
        tau = np.clip(gain * w, -friction, friction)
        usable = np.isfinite(tau + w) & (felt > 0.0)
        self.reference_velocity = np.where(usable, w, 0.0)
        self.last = np.where(usable, tau, 0.0)
        return self.last
