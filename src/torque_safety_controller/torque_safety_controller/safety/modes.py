# SPDX-License-Identifier: Apache-2.0
"""Modes of the controller node."""

from __future__ import annotations

from enum import Enum

CONTROLS = ("torque", "position")
"""Kinds of commands to the robot's drives."""


class Mode(Enum):
    """Mode of the controller node."""

    TRACKING = "TRACKING"
    """Follows its goals inside all limits."""
    HOLD = "HOLD"
    """Brings the arm to rest: gravity compensation and damping inside the torque limits."""
    POSITION = "POSITION"
    """The robot's own position control holds the position that it is sent."""
    STOPPED = "STOPPED"
    """Publishes nothing; the robot's own watchdog brakes it."""


class ModeKeeper:
    """Present mode, its reason and the number of changes."""

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
