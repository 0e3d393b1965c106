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
from torque_safety_controller.linalg.cholesky import factorise, solve
from viability_bounds_pkg.compiled import bound, compiled

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
        self._wanted = _Coefficients(*np.zeros((5, n)))
        self._present = _Coefficients(*np.zeros((5, n)))
        self._M, self._v, self._a_last = np.eye(n), np.zeros(n), np.zeros(n)
        self.settings = settings
        self._compensate = bound(
            _compensate,
            self._present,
            self._wanted,
            self._M,
            self._v,
            self._a_last,
            self.reference_velocity,
            self.last,
            numbers=4,
        )
        self.reset()

    @property
    def settings(self) -> FrictionSettings:
        """Settings; their coefficients take the place of the old ones little by little."""
        return self._settings

    @settings.setter
    def settings(self, settings: FrictionSettings) -> None:
        self._settings = settings
        model, wanted = settings.model, self._wanted
        wanted.coulomb[:] = settings.scale * model.coulomb
        wanted.excess[:] = settings.scale * (model.static - model.coulomb)
        wanted.viscous[:] = settings.scale * model.viscous
        wanted.stribeck_velocity[:] = model.stribeck_velocity
        wanted.budget[:] = settings.budget

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
        self._M[:], self._v[:], self._a_last[:] = M, v, a_last
        settings = self._settings
        gamma = GAIN / period if settings.gain is None else float(settings.gain)
        blend = -math.expm1(-elapsed / _FADING_TIME)
        self._faded = self._compensate(blend, elapsed, float(settings.leak_rate), gamma)
        return self.last


@compiled
def _compensate(
    present: _Coefficients,
    wanted: _Coefficients,
    M: Array,
    v: Array,
    a_last: Array,
    w: Array,
    tau: Array,
    blend: float,
    dt: float,
    leak_rate: float,
    gamma: float,
) -> bool:
    """Make a step in the coefficients, `w` and `tau`; return whether no friction is left in them.

    The reference velocity is that of constant acceleration and velocity within the step.
    """
    coulomb, excess, viscous, stribeck_velocity, budget = present
    decay = math.exp(-leak_rate * dt)
    held = -math.expm1(-leak_rate * dt) / (leak_rate * dt) if leak_rate * dt > 0.0 else 1.0
    L, M_inv = M.copy(), np.eye(len(v))
    if not factorise(L):  # no mass matrix
        w[:], tau[:] = 0.0, 0.0
        return False
    solve(L, M_inv)
    gain = gamma / np.diag(M_inv)  # of the inertia felt while others give way
    largest = 0.0
    for i in range(len(v)):
        coulomb[i] += blend * (wanted.coulomb[i] - coulomb[i])
        excess[i] += blend * (wanted.excess[i] - excess[i])
        viscous[i] += blend * (wanted.viscous[i] - viscous[i])
        stribeck_velocity[i] += blend * (wanted.stribeck_velocity[i] - stribeck_velocity[i])
        budget[i] += blend * (wanted.budget[i] - budget[i])
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
