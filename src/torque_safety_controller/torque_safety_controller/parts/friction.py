# SPDX-License-Identifier: Apache-2.0
"""Friction compensation in the direction in which the joint is wanted to go.

[Benallegue2021] names it as the next step. With the friction of a moving joint at most F(v), in
`friction/settings.py`, and a reference velocity w that integrates the acceleration asked for,

    w' = a_ref - theta (w - v),
    tau_f = clip(gamma m w, -k F(v), k F(v)),    m = 1 / (M^-1)_ii,

with k the share to compensate, and m the inertia that the joint's motor feels. A joint that moves
as it should has w = v, and its friction is compensated; one at rest has w ~ a_ref / theta: the
acceleration wanted decides the direction, and takes it out of its stiction.
`docs/guides/tuning.md` has the law, and what keeps it from driving the joint: of the friction
itself it never takes more than there is, and of too large a model it makes a stiffer spring.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from torque_safety_controller.friction.settings import GAIN, FrictionSettings
from torque_safety_controller.integral_feedback.leaky_integrator import leak_factors
from torque_safety_controller.robot_model import RobotModel
from torque_safety_controller.step import Part, Settings, Step

Array = NDArray[np.float64]

_FADING_TIME = 0.2  # s; in which new coefficients take the place of old ones
_NEGLIGIBLE = 1e-9  # N m


class Friction(Part):
    """Adds the torque that compensates friction where a joint is wanted to go.

    Args:
        settings: may be replaced between steps: the torque does not jump.

    Attributes:
        last: what the last step compensated, shape (n,), N m.
        reference_velocity: w, shape (n,), rad/s.
    """

    def __init__(self, settings: FrictionSettings) -> None:
        self.settings = settings
        self.reset()

    @property
    def settings(self) -> FrictionSettings:
        """Settings, whose coefficients take the place of the old ones little by little."""
        return self._settings

    @settings.setter
    def settings(self, settings: FrictionSettings) -> None:
        self._settings, model = settings, settings.model
        dry = settings.scale * np.array([model.coulomb, model.static - model.coulomb])
        viscous = settings.scale * model.viscous
        self._wanted = np.vstack([dry, viscous, model.stribeck_velocity, settings.budget])

    @property
    def idle(self) -> bool:
        """Whether nothing is compensated."""
        return self._faded and self._settings.scale == 0.0

    def configure(self, settings: Settings) -> None:
        """See `Part.configure`."""
        self.settings = settings.friction

    def reset(self, robot: RobotModel | None = None) -> None:
        """Forget the past: the compensation begins with nothing and fades in."""
        # Of Coulomb, of stiction beyond it, viscous; Stribeck velocity and budget.
        self._used = self._wanted.copy()
        self._used[:3] = 0.0
        self._faded, self._started = True, False
        self.last = self.reference_velocity = np.zeros(self._wanted.shape[1])

    def prepare(self, step: Step) -> None:
        """Add the torque to that of the model."""
        robot, known = step.robot, step.elapsed if step.learns else 0.0
        step.torque = step.torque + self.torque(robot.M, robot.v, step.a_last, known, robot.dt)

    def report(self) -> dict[str, Any]:
        """See `Part.report`."""
        return {"friction_torque_nm": self.last}

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
        if self.idle:
            if self._started:
                self.reset()
            return self.last
        if not self._started:
            self.reference_velocity = v
            self._started = True
        settings = self._settings
        kept, held = leak_factors(settings.leak_rate, elapsed, paper_form=False)
        try:
            self.last, self.reference_velocity, left = _compensate(
                self._used,
                self._wanted,
                -math.expm1(-elapsed / _FADING_TIME),
                self.reference_velocity,
                M,
                v,
                a_last,
                kept,
                elapsed * held,
                GAIN / period if settings.gain is None else settings.gain,
            )
            self._faded = left < _NEGLIGIBLE
        except np.linalg.LinAlgError:  # no mass matrix
            self.last = self.reference_velocity = np.zeros(v.size)
        return self.last


@njit(cache=True)
def _compensate(
    used: Array,
    wanted: Array,
    blend: float,
    w_last: Array,
    M: Array,
    v: Array,
    a_last: Array,
    decay: float,
    held: float,
    gamma: float,
) -> tuple[Array, Array, float]:
    """Return the torque, the reference velocity, and the largest friction compensated.

    Args:
        used: coefficients, shape (5, n); blended with those wanted, in place.
        wanted: coefficients, shape (5, n).
        blend: share of those wanted that a step takes.
        w_last: reference velocity of the last step, shape (n,), rad/s.
        M: mass matrix, shape (n, n), kg m^2.
        v: velocity, shape (n,), rad/s.
        a_last: acceleration commanded in the last step, shape (n,), rad/s^2.
        decay: what the step leaves of the reference velocity.
        held: time for which it gains the acceleration, s.
        gamma: see the module.
    """
    used += blend * (wanted - used)
    inverse = np.linalg.inv(M)
    tau, w, left = np.zeros(v.size), np.zeros(v.size), 0.0
    for j in range(v.size):
        left = max(left, used[0, j] + used[1, j] + used[2, j])
        wish = decay * w_last[j] + (1.0 - decay) * v[j] + held * a_last[j]
        if not (math.isfinite(v[j]) and wish == wish and 0.0 < inverse[j, j] < np.inf):
            continue
        gain = gamma / inverse[j, j]  # of the inertia felt while other joints give way
        speed = abs(v[j])
        stiction = used[1, j] * math.exp(-((speed / used[3, j]) ** 2))
        friction = min(used[0, j] + stiction + used[2, j] * speed, used[4, j])
        # More than what calls for all of the friction is nothing to remember.
        enough = friction / gain
        w[j] = min(max(wish, min(v[j], 0.0) - enough), max(v[j], 0.0) + enough)
        tau[j] = min(max(gain * w[j], -friction), friction)
    return tau, w, left
