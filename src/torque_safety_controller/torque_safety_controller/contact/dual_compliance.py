"""Dual compliance: who pulls at the hand leads it, who pushes elsewhere does not move it.

[Benallegue2021], IV-C: below a threshold of the wrench at the hand its pose is held; above, it
yields, and where it is let go becomes the new goal.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class DualSettings:
    """When the hand yields.

    Attributes:
        force: N, above which it does.
        moment: N m, above which it does.
        release: share of both below which it stops.
    """

    force: float = 10.0
    moment: float = 2.0
    release: float = 0.5


class DualCompliance:
    """Decides, with hysteresis.

    Args:
        settings: may be replaced at any time.

    Attributes:
        settings: as given.
        yielding: whether the hand is to yield.
    """

    def __init__(self, settings: DualSettings) -> None:
        self.settings = settings
        self.yielding = False

    def update(self, wrench: np.ndarray) -> bool:
        """Return whether the hand is to yield to `wrench`, shape (6,), N and N m."""
        settings = self.settings
        share = settings.release if self.yielding else 1.0
        self.yielding = (
            math.hypot(*wrench[:3]) > share * settings.force
            or math.hypot(*wrench[3:]) > share * settings.moment
        )
        return self.yielding
