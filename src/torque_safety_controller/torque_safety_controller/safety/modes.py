# SPDX-License-Identifier: Apache-2.0
"""Which mode the controller is in, and why."""

from __future__ import annotations

from enum import Enum

CONTROLS = ("torque", "position")
"""What the robot's drives are commanded by."""


class Mode(Enum):
    """What the controller does."""

    TRACKING = "TRACKING"
    """Serves its goals inside all limits."""
    HOLD = "HOLD"
    """Brings the arm to rest: gravity compensation and damping inside the torque limits."""
    POSITION = "POSITION"
    """The robot's own drives hold the position that they are sent."""
    STOPPED = "STOPPED"
    """Publishes nothing, so that the robot's own watchdog brakes it."""


class ModeKeeper:
    """Keeps the mode, its reason and how often it changed."""

    def __init__(self) -> None:
        self.mode = Mode.STOPPED
        self.reason = "no joint state yet"
        self.changes = 0

    def set(self, mode: Mode, reason: str) -> bool:
        """Enter `mode`; return whether mode or reason changed."""
        if (mode, reason) == (self.mode, self.reason):
            return False
        self.mode, self.reason = mode, reason
        self.changes += 1
        return True
