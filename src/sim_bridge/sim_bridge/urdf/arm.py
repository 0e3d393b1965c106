# SPDX-License-Identifier: Apache-2.0
"""An arm of a robot description, and its limits."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ConfiguredArm:
    """An arm of n joints; arrays of shape (n,) in their order.

    Attributes:
        urdf: text of the URDF.
        joints: names of the joints that move.
        locked: where other joints are locked, rad or m by name.
        q_min, q_max: position limits, rad.
        v_max: velocity limits, rad/s.
        tau_max: torque limits, N m.
    """

    urdf: str
    joints: tuple[str, ...]
    locked: dict[str, float]
    q_min: Array
    q_max: Array
    v_max: Array
    tau_max: Array
