"""Passivity-based integral action that cannot run away: [Benallegue2021], II-B and III-A to C.

Of the torque of a control step,

    tau = M a_ref + h + (C + K) s,   K = lambda diag(M),   s' = a_ref - v',

this is the last term, with s forgotten at two rates, and limited. It is known before the QP is
solved, which then keeps the sum within the torque limits. `docs/integral_action.md` derives it
all, and says where it goes beyond the paper.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from torque_safety_controller.integral_feedback import kernels
from torque_safety_controller.integral_feedback.leaky_integrator import LeakyIntegrator
from torque_safety_controller.integral_feedback.settings import (
    METHODS,
    IntegralSettings,
    paper_settings,
)
from viability_bounds_pkg.exceptions import ArmSafetyError, SettingError

__all__ = [
    "IntegralFeedback",
    "IntegralSettings",
    "LeakyIntegrator",
    "SeedingError",
    "paper_settings",
]

Array = NDArray[np.float64]

_AMPLIFIED = 10.0  # how much larger than the torque asked for K s may be when it is seeded


class SeedingError(ArmSafetyError, ValueError):
    """The integral action cannot be made to give the torque asked for."""


class IntegralFeedback:
    """Additional torque (C + K) s of one arm.

    Args:
        settings: may be replaced between steps: the torque does not jump.

    Attributes:
        s: s~ of eq. (14), corrected, that the last torque was computed from, shape (n,), rad/s.
            Like all arrays below it is overwritten by the next step.
        gain_torque: K s~ before it was corrected, shape (n,), N m.
        limited_gain_torque: what the limits left of it: the additional torque without C s~,
            shape (n,), N m.
        additional_torque: what `torque` returned last, shape (n,), N m.
        fast, slow: both integrators, shape (n,), rad/s.
        widening: what has been added to the budgets, shape (n,), N m.
    """

    def __init__(self, settings: IntegralSettings) -> None:
        n = len(settings.budget)
        self._shape = (n,)
        self._memory = np.zeros((4, n))
        self._report = np.zeros((5, n))
        self._scalars = np.zeros(2)
        self._started = False
        self._settings = settings
        self._next: IntegralSettings | None = None
        self._adopt(settings)
        self.fast, self.slow, _, self.widening = self._memory
        self.s, self.gain_torque, self.limited_gain_torque, self.additional_torque, _ = (
            self._report
        )
        # The first call compiles; let it be this one and not one in a control loop.
        self.torque(np.eye(n), np.zeros((n, n)), np.zeros(n), np.zeros(n), 0.0)
        self._started = False

    @property
    def settings(self) -> IntegralSettings:
        """Settings; new ones begin after the next step, with the torque that the old ones gave."""
        return self._settings if self._next is None else self._next

    @settings.setter
    def settings(self, settings: IntegralSettings) -> None:
        if settings.budget.shape != self._shape:
            n = self._shape[0]
            raise SettingError("budget", settings.budget, f"one number for each of {n} joints")
        if self._started:
            self._next = settings
        else:
            self._adopt(settings)

    @property
    def saturated(self) -> NDArray[np.bool_]:
        """Which joints asked for more than they were given, shape (n,)."""
        return self._report[kernels.SATURATED] > 0.0

    @property
    def lambda_w(self) -> float:
        """Factor of eq. (10) in the last step: how much of K s fits into the budgets."""
        return float(self._scalars[kernels.FACTOR])

    @property
    def leak(self) -> float:
        """Rate at which s is forgotten on top of theta to stay passive, 1/s; mostly 0."""
        return float(self._scalars[kernels.LEAK])

    def start(self, v: ArrayLike) -> None:
        """Set s to zero and the budgets to what they should be.

        Args:
            v: velocity that increments of s count from, shape (n,), rad/s.

        Raises:
            ValueError: v is unusable.
        """
        v = self._vector("v", v)
        self._memory[:] = 0.0
        self._memory[kernels.V_LAST] = v
        self._report[:] = 0.0
        self._scalars[:] = 0.0, 1.0
        self._started = True
        if self._next is not None:
            self._adopt(self._next)

    def torque(self, M: Array, C: Array, v: Array, a_ref_last: Array, dt: float) -> Array:
        """Return the additional torque of a control step, shape (n,), N m.

        To be called once a step, before the QP. The first call is a `start`.

        Args:
            M: mass matrix, shape (n, n).
            C: Coriolis matrix with M' - 2 C skew-symmetric, as Pinocchio's, shape (n, n).
            v: velocity, shape (n,), rad/s.
            a_ref_last: acceleration commanded in the last step, shape (n,), rad/s^2.
            dt: time since the last step, s.

        Raises:
            ValueError: wrong shapes, numbers that are not finite, or dt < 0; nothing has
                changed then.
        """
        self._check(M, C, v, a_ref_last)
        if not kernels.usable(M, C, v, a_ref_last, dt):
            raise ValueError(f"M, C, v, a_ref_last and dt = {dt} must be finite, dt >= 0")
        if not self._started:
            self.start(v)
        kernels.advance(self._memory, self._scalars, v, a_ref_last, dt, *self._rates)
        self._evaluate(M, C)
        torque = self.additional_torque.copy()
        if self._next is not None:
            self._change(self._next, M, C, torque)
        return torque

    def skip(self, v: ArrayLike, dt: float) -> None:
        """Let a time pass of which nothing is known: the integral only leaks, and is not kicked.

        For a jump in time, a pause, steps that another controller did.

        Args:
            v: velocity that increments count from now on, shape (n,), rad/s.
            dt: how long it took, s; 0 if that is not known.

        Raises:
            ValueError: v or dt is unusable.
        """
        v = self._vector("v", v)
        if not 0.0 <= dt < math.inf:
            raise ValueError(f"dt must be a finite number >= 0, is {dt}")
        if not self._started:
            self.start(v)
        self._memory[kernels.V_LAST] = v
        kernels.advance(self._memory, self._scalars, v, np.zeros(self._shape), dt, *self._rates)

    def seed(self, additional_torque: ArrayLike, M: Array, C: Array) -> Array:
        """Set the integrators so that the additional torque is this one; return it.

        It is then forgotten at the slow rate. A budget that it exceeds is widened, only as far as
        it must, and returns to what it should be with `widening_time`. The returned torque is
        this step's; `torque` goes on from it in the next.

        Args:
            additional_torque: shape (n,), N m.
            M: mass matrix, shape (n, n).
            C: Coriolis matrix, shape (n, n).

        Raises:
            ValueError: unusable arguments.
            SeedingError: not started, or the arm moves so fast that C + K cannot be inverted;
                nothing has changed then.
        """
        torque = self._vector("additional_torque", additional_torque)
        self._check(M, C, torque, torque)
        if not self._started:
            raise SeedingError("the integral action has not been started")
        settings = self.settings
        s = _state_for(torque, M, C, settings.lambda_)
        if s is None:
            raise SeedingError("the arm moves too fast: C + K cannot be inverted")
        self._adopt(settings)
        self.fast[:] = 0.0
        self._remember_slowly(s)
        self._widen(s, M, torque)
        self._scalars[kernels.LEAK] = 0.0
        self._evaluate(M, C)
        return self.additional_torque.copy()

    def _evaluate(self, M: Array, C: Array) -> None:
        kernels.evaluate(M, C, self._memory, self._scalars, self._report, *self._law)

    def _adopt(self, settings: IntegralSettings) -> None:
        self._settings, self._next = settings, None
        self._rates = (
            settings.theta_fast,
            settings.theta_slow,
            settings.paper_form,
            settings.widening_time,
        )
        self._law = (
            settings.budget.copy(),
            settings.lambda_,
            settings.mu,
            METHODS.index(settings.anti_windup),
            settings.whole_torque,
            settings.correct_state,
        )

    def _change(self, settings: IntegralSettings, M: Array, C: Array, torque: Array) -> None:
        """Go over to new settings so that they give the same torque as the old ones."""
        old = self._settings
        self._adopt(settings)
        if _same_torque(old, settings):
            return
        s = _state_for(torque, M, C, settings.lambda_)
        if s is None:
            s = self.limited_gain_torque / (settings.lambda_ * np.diagonal(M))
        self.fast *= old.lambda_ / settings.lambda_
        self._remember_slowly(s)
        self._widen(s, M, torque)

    def _remember_slowly(self, s: Array) -> None:
        """Make s~ what it shall be, and leave what is forgotten fast as it is."""
        mu = self._settings.mu
        if mu < 1.0:
            self.slow[:] = (s - mu * self.fast) / (1.0 - mu)
        else:
            self.fast[:] = s

    def _widen(self, s: Array, M: Array, torque: Array) -> None:
        """Let the budgets take `torque`, and widen them no more than that takes."""
        settings = self._settings
        limited = torque if settings.whole_torque else settings.lambda_ * np.diagonal(M) * s
        self.widening[:] = np.maximum(np.abs(limited) - settings.budget, 0.0)

    def _check(self, M: Array, C: Array, v: Array, a: Array) -> None:
        shape = self._shape
        if not (v.shape == a.shape == shape and M.shape == C.shape == shape + shape):
            raise ValueError(
                f"vectors must have shape {shape}, matrices {shape + shape}: "
                f"M {M.shape}, C {C.shape}, {v.shape}, {a.shape}"
            )

    def _vector(self, name: str, x: ArrayLike) -> Array:
        x = np.array(x, dtype=np.float64)
        if x.shape != self._shape or not np.isfinite(x).all():
            raise ValueError(f"{name} must be {self._shape[0]} finite numbers, is {x}")
        return x


def _same_torque(a: IntegralSettings, b: IntegralSettings) -> bool:
    """Return whether both give the same torque from the same integrators."""
    names = ("lambda_", "mu", "anti_windup", "whole_torque", "correct_state")
    same = all(getattr(a, name) == getattr(b, name) for name in names)
    return same and np.array_equal(a.budget, b.budget)


def _state_for(torque: Array, M: Array, C: Array, gain: float) -> Array | None:
    """Return the s with (C + K) s = torque, shape (n,); None if there is none of sensible size."""
    K = gain * np.diagonal(M)
    try:
        s = np.linalg.solve(C + np.diag(K), torque)
    except np.linalg.LinAlgError:
        return None
    largest = np.abs(torque).max()
    # A NaN is not of sensible size.
    return s if np.abs(K * s).max() <= _AMPLIFIED * largest else None
