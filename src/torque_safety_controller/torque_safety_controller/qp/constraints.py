# SPDX-License-Identifier: Apache-2.0
"""Constraints on the joint accelerations: their bounds, and further linear ones."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from torque_safety_controller.robot_model import RobotModel
from viability_bounds_pkg.compiled import compiled

Array = NDArray[np.float64]


class AccelerationRange(NamedTuple):
    """Lower and upper bounds of the joint accelerations."""

    lower: Array
    """Shape (n,), rad/s^2; -inf for no bound."""
    upper: Array
    """Shape (n,), rad/s^2, not below `lower`; inf for no bound."""


def fault_of(lower: Array, upper: Array) -> str:
    """Return what is wrong with finite bounds, shape (n,) each, in words; empty for nothing."""
    return _FAULTS[_fault(lower, upper)]


_FAULTS = "", "not finite", "lower above upper"


@compiled
def _fault(lower: Array, upper: Array) -> int:
    crossed = False
    for i in range(lower.size):
        if not (math.isfinite(lower[i]) and math.isfinite(upper[i])):
            return 1
        crossed = crossed or lower[i] > upper[i]
    return 2 if crossed else 0


class LinearConstraints(NamedTuple):
    """The constraints ``lower <= G a <= upper`` on the joint accelerations a.

    Equal limits make an equality. Where the torque limits leave no solution, these constraints
    and the acceleration bounds are relaxed together, by the least sum of squares. Scaling a row
    of G and its limits by s multiplies the cost of relaxing it by s^2, up to a length of 1e4 of
    the row.
    """

    G: Array
    """Shape (k, n)."""
    lower: Array
    """Shape (k,); -inf for no limit."""
    upper: Array
    """Shape (k,), not below `lower`; inf for no limit."""


class Constraint(Protocol):
    """Anything that limits the accelerations of the arm in its current state."""

    def constraint(
        self, robot: RobotModel, bounds: AccelerationRange, disturbance: Array | None = None
    ) -> LinearConstraints | None:
        """Return the constraints of one step; None for none.

        Args:
            robot: updated to the current state.
            bounds: of the accelerations, which apply besides.
            disturbance: acceleration on top of the commanded one, shape (n,), rad/s^2.
        """


def stack_constraints(parts: Sequence[LinearConstraints | None]) -> LinearConstraints | None:
    """Return all constraints as one, in order; None without any."""
    given = [part for part in parts if part is not None and len(part.G)]
    if len(given) < 2:
        return given[0] if given else None
    return LinearConstraints(*(np.concatenate(each) for each in zip(*given, strict=True)))
