# SPDX-License-Identifier: Apache-2.0
"""What every law of integral action offers, and what it needs to know of the arm."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torque_safety_controller.integral_feedback.settings import IntegralSettings

Array = NDArray[np.float64]


class ArmTerms(NamedTuple):
    """Dynamics, task and velocity of an arm in one step, in contiguous arrays.

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


class IntegralLaw(ABC):
    """A torque made of the acceleration errors s' = a_ref - v' of the past.

    Args:
        settings: their number of joints stays.
        memory: named tuple of arrays, one of which is `v`.

    Attributes:
        settings: after a change of them `initialise` keeps the torque continuous.
        memory: what the torque continues from.
        saturated: which joints were at their limits in the last step, shape (n,).
    """

    def __init__(self, settings: IntegralSettings, memory: Any) -> None:
        self.settings = settings
        self.memory = memory
        self.saturated = np.zeros(len(settings.budget), dtype=bool)

    def reset(self, arm: ArmTerms) -> None:
        """Forget everything; increments of s count from this state on."""
        self.memory = type(self.memory)(*map(np.zeros_like, self.memory))
        self.memory.v[:] = arm.v
        self.saturated = np.zeros_like(self.saturated)

    @abstractmethod
    def torque(self, arm: ArmTerms, a_last: Array, dt: float) -> Array:
        """Return the additional torque of a control step, shape (n,), N m.

        To be called once a step, before the QP.

        Args:
            arm: as it is now.
            a_last: acceleration commanded in the last step, shape (n,), rad/s^2.
            dt: time since the last step, s, >= 0.

        Raises:
            ValueError: unusable terms of the arm; nothing has changed then.
        """

    @abstractmethod
    def initialise(self, torque: Array, arm: ArmTerms) -> Array:
        """Choose the memory so that it gives `torque`, and return what it gives of it.

        Args:
            torque: shape (n,), N m.
            arm: as it is now.

        Raises:
            ValueError: it cannot be done.
        """

    @property
    @abstractmethod
    def leak_rates(self) -> dict[str, float]:
        """Rates at which arrays of the memory are forgotten, 1/s, by name."""

    def skip(self, arm: ArmTerms, dt: float) -> None:
        """Let a time pass of which nothing is known: the memory leaks and takes no increment.

        Args:
            arm: as it is now.
            dt: how long it took, s, >= 0; 0 if that is not known.

        Raises:
            ValueError: the velocity is not finite; nothing has changed then.
        """
        if not np.isfinite(arm.v).all():
            raise ValueError(f"v must be finite, is {arm.v}")
        left = {
            name: math.exp(-rate * dt) * getattr(self.memory, name)
            for name, rate in self.leak_rates.items()
        }
        self.memory = self.memory._replace(v=arm.v.copy(), **left)
