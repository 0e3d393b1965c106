"""Friction compensation in the direction in which the joint is wanted to go.

[Benallegue2021] names it as the next step. With the friction of a moving joint at most F(v), in
`friction_settings`, and a reference velocity w that integrates the acceleration asked for,

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

from torque_safety_controller.friction.settings import FrictionSettings
from torque_safety_controller.linalg.cholesky import factorise
from viability_bounds_pkg.compiled import compiled

Array = NDArray[np.float64]

GAIN = 0.1
"""gamma in control rates, by default: how soon w calls for all of the friction."""

_FADING_TIME = 0.2  # s; in which new coefficients take the place of old ones
_NEGLIGIBLE = 1e-9  # N m

_COULOMB, _EXCESS, _VISCOUS, _STRIBECK, _BUDGET = range(5)  # rows of the coefficients


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
        self._present = self._wanted.copy()
        self.start()
        # The first call compiles; let it be this one and not one in a control loop.
        self._gain = 1.0
        self._step(np.eye(n), np.zeros(n), np.zeros(n), 0.0, 1.0)

    @property
    def settings(self) -> FrictionSettings:
        """Settings; their coefficients take the place of the old ones little by little."""
        return self._settings

    @settings.setter
    def settings(self, settings: FrictionSettings) -> None:
        self._settings = settings
        self._wanted = _coefficients(settings)
        if self.idle:
            self._present[_STRIBECK:] = self._wanted[_STRIBECK:]

    @property
    def idle(self) -> bool:
        """Whether nothing is compensated."""
        return self._settings.scale == 0.0 and self._faded

    def start(self) -> None:
        """Forget the past: the compensation begins with nothing and fades in."""
        self._present[:_STRIBECK] = 0.0
        self._present[_STRIBECK:] = self._wanted[_STRIBECK:]
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
            self.reference_velocity[:] = v
            self._gain = self._wanted_gain(period)
            self._started = True
        self._step(M, v, a_last, elapsed, period)
        return self.last

    def _wanted_gain(self, period: float) -> float:
        gain = self._settings.gain
        return GAIN / period if gain is None else gain

    def _step(self, M: Array, v: Array, a_last: Array, elapsed: float, period: float) -> None:
        blend = -math.expm1(-elapsed / _FADING_TIME)
        self._gain += blend * (self._wanted_gain(period) - self._gain)
        self._faded = _compensate(
            self._present,
            self._wanted,
            blend,
            M,
            v,
            a_last,
            elapsed,
            self._settings.theta,
            self._gain,
            self.reference_velocity,
            self.last,
        )


def _coefficients(settings: FrictionSettings) -> Array:
    """Return what the kernel evaluates, shape (5, n): the share is in the model."""
    model, scale = settings.model, settings.scale
    return np.stack(
        [
            scale * model.coulomb,
            scale * (model.static - model.coulomb),
            scale * model.viscous,
            model.stribeck_velocity,
            settings.budget,
        ]
    )


@compiled
def _compensate(present, wanted, blend, M, v, a_last, dt, theta, gamma, w, tau):
    """Make a step in `present`, `w` and `tau`, and return whether no friction is left in them.

    The reference velocity is that of constant acceleration and velocity within the step.
    """
    decay = math.exp(-theta * dt)
    held = -math.expm1(-theta * dt) / (theta * dt) if theta * dt > 0.0 else 1.0
    faded = True
    inertia = _felt_inertia(M)
    for i in range(len(v)):
        for row in range(len(present)):
            present[row, i] += blend * (wanted[row, i] - present[row, i])
        speed = abs(v[i])
        stiction = present[_EXCESS, i] * math.exp(-((speed / present[_STRIBECK, i]) ** 2))
        friction = present[_COULOMB, i] + stiction + present[_VISCOUS, i] * speed
        friction = min(friction, present[_BUDGET, i])
        gain = gamma * inertia[i]
        # More than what calls for all of the friction is nothing to remember.
        enough = friction / gain
        w_new = decay * w[i] + (1.0 - decay) * v[i] + held * dt * a_last[i]
        w[i] = min(max(w_new, min(v[i], 0.0) - enough), max(v[i], 0.0) + enough)
        tau[i] = min(max(gain * w[i], -friction), friction)
        if not math.isfinite(tau[i] + w[i]):
            w[i] = tau[i] = 0.0
        largest = present[_COULOMB, i] + present[_EXCESS, i] + present[_VISCOUS, i]
        faded = faded and largest < _NEGLIGIBLE
    return faded


@compiled
def _felt_inertia(M):
    """Return 1 / (M^-1)_ii, shape (n,): with others free to give way; NaN if there is no such."""
    n = len(M)
    inertia = np.full(n, np.nan)
    L = M.copy()
    if not factorise(L):
        return inertia
    x = np.empty(n)
    for i in range(n):
        total = 0.0
        for j in range(i, n):
            s = 1.0 if j == i else 0.0
            for k in range(i, j):
                s -= L[j, k] * x[k]
            x[j] = s / L[j, j]
            total += x[j] * x[j]
        inertia[i] = 1.0 / total
    return inertia
