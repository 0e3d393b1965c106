# SPDX-License-Identifier: Apache-2.0
"""Torques against gravity, where the robot adds them by itself.

In this project a torque is all that a motor gives: tau in M a + h = tau + .... Many robots take
commands without the part g(q) that holds the arm, and add it. Torques become those of the robot
where they leave a node, and those of the motors where they come in:

    command = tau - g(q),    tau = effort + g(q).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from viability_bounds_pkg.parameter import switch

Array = NDArray[np.float64]

Gravity = Callable[[Array], Array]
"""Returns g(q), shape (n,), N m, for positions, shape (n,), rad."""


@dataclass(frozen=True, eq=False, kw_only=True)
class TorqueConvention:
    """What the torques in a robot's messages are."""

    command_includes_gravity: bool = switch(
        "joint_commands hold the arm against gravity; false for a robot that adds this by itself",
        default=True,
    )
    effort_includes_gravity: bool = switch(
        "effort in joint_states contains the torque against gravity", default=True
    )


def gravity_beyond(model: pin.Model, included: bool) -> Gravity | None:
    """Return g of a model, which may change; None where messages include it."""
    if included:
        return None
    data = model.createData()
    return lambda q: np.array(pin.computeGeneralizedGravity(model, data, q))
