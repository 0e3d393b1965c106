# SPDX-License-Identifier: Apache-2.0
"""What every integral action offers, and what it needs to know of the arm."""

from __future__ import annotations

import math
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from torque_safety_controller.integral_feedback.settings import IntegralSettings

Array = NDArray[np.float64]


class ArmTerms(NamedTuple):
    """Dynamics, task and velocity of an arm in one step.

    Attributes:
        M: mass matrix, shape (n, n), kg m^2.
        C: Coriolis matrix with M' - 2 C skew-symmetric, as Pinocchio's, shape (n, n), N m s.
        J: Jacobian of the task, shape (m, n).
        J_dot: its time derivative, shape (m, n).
        v: velocity, shape (n,), rad/s.
    """

    M: Array
    C: Array
    J: Array
    J_dot: Array
    v: Array

    def check(self, n: int, m: int) -> None:
        """Raise `ValueError` unless these are terms of n joints and m rows of a task."""
        M, C, J, J_dot, v = self
        if not (
            M.shape == C.shape == (n, n) and J.shape == J_dot.shape == (m, n) and v.shape == (n,)
        ):
            found = ", ".join(f"{name} {x.shape}" for name, x in self._asdict().items())
            raise ValueError(f"for {n} joints and a task of {m} rows: {found}")

    def check_velocity(self) -> None:
        """Raise `ValueError` unless the velocity is finite."""
        if not np.isfinite(self.v).all():
            raise ValueError(f"v must be finite, is {self.v}")


class IntegralAction(Protocol):
    """A torque made of the acceleration errors s' = a_ref - v' of the past."""

    @property
    def settings(self) -> IntegralSettings:
        """Settings; after a change of them `initialise` keeps the torque continuous."""

    @settings.setter
    def settings(self, settings: IntegralSettings) -> None: ...

    @property
    def saturated(self) -> NDArray[np.bool_]:
        """Which joints are at their limits, shape (n,)."""

    def reset(self, arm: ArmTerms) -> None:
        """Forget everything; increments of s count from this state on."""

    def torque(self, arm: ArmTerms, a_last: Array, dt: float) -> Array:
        """Return the additional torque of a control step, shape (n,), N m.

        To be called once a step, before the QP.

        Args:
            arm: as it is now.
            a_last: acceleration commanded in the last step, shape (n,), rad/s^2.
            dt: time since the last step, s.

        Raises:
            ValueError: unusable arguments; nothing has changed then.
        """

    def skip(self, arm: ArmTerms, dt: float) -> None:
        """Let a time pass of which nothing is known: the memory leaks and takes no increment.

        Args:
            arm: as it is now.
            dt: how long it took, s; 0 if that is not known.

        Raises:
            ValueError: the velocity or time is unusable; nothing has changed then.
        """

    def initialise(self, torque: Array, arm: ArmTerms) -> Array:
        """Choose the memory so that the additional torque is `torque`, and return that of it.

        A budget that it exceeds is widened, only as far as it must, and returns to what it
        should be with `WIDENING_TIME`.

        Args:
            torque: shape (n,), N m.
            arm: as it is now.

        Raises:
            ValueError: it cannot be done.
        """


def check_time(dt: float) -> None:
    """Raise `ValueError` unless `dt` is a finite number >= 0."""
    if not 0.0 <= dt < math.inf:
        raise ValueError(f"dt must be a finite number >= 0, is {dt}")
