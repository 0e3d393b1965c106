# SPDX-License-Identifier: Apache-2.0
"""Settings of forces at the hand."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from torque_safety_controller.contact.admittance import AdmittanceGains


@dataclass(frozen=True, eq=False)
class InteractionSettings:
    """What may change while the controller runs.

    Attributes:
        directions: of the end effector's axes, those in which force is controlled, shape (6,),
            bool.
        gains: of the admittance task when a wrench is exerted.
        yield_threshold: force and moment above which the hand yields, N and N m; None never.
        yielding_gains: of the admittance task when it does.
    """

    directions: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(6, dtype=bool))
    gains: AdmittanceGains = AdmittanceGains()
    yield_threshold: tuple[float, float] | None = None
    yielding_gains: AdmittanceGains = AdmittanceGains((0.1, 1.0), (0.0, 0.0), (0.25, 1.0))
