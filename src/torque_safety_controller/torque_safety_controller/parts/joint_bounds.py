# SPDX-License-Identifier: Apache-2.0
"""Bounds of the joint accelerations: those that came for the state, or the controller's own."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from torque_safety_controller.qp import AccelerationRange
from torque_safety_controller.step import Part, Step
from viability_bounds_pkg.viability import AccelerationBounds

Array = NDArray[np.float64]


Bounds = Callable[[Array, Array], AccelerationBounds]


class JointBounds(Part):
    """Keeps each joint within the limits of its acceleration.

    Args:
        own: bounds in a state (q, v), for steps without limits; None for no bounds there: the arm
            brakes regardless of positions and speeds.
    """

    def __init__(self, own: Bounds | None = None) -> None:
        self._own = own or _unbounded

    def prepare(self, step: Step) -> None:
        """Set the bounds that later parts may only narrow."""
        limits = step.limits
        if limits is None:
            lower, upper, _ = self._own(step.robot.q, step.robot.v)
            limits = AccelerationRange(lower, upper)
        step.bounds = limits


def _unbounded(q: Array, v: Array) -> AccelerationBounds:
    return AccelerationBounds(q - np.inf, q + np.inf, np.ones(q.shape, dtype=bool))
