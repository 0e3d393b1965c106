# SPDX-License-Identifier: Apache-2.0
"""What the controller is to do with a state: by which share it serves its goals, and learns."""

from __future__ import annotations

from typing import NamedTuple


class Order(NamedTuple):
    """What the supervisor asks of a control step.

    Attributes:
        share: of the goals' accelerations, from 0 to 1; the rest brings the arm to rest.
        track: whether goals are served; else the arm is brought to rest.
        obeyed: whether the last commands acted, as far as is known; while they do not, nothing is
            learned from how the arm moves.
        forget_disturbance: whether what was learned of disturbances no longer holds.
        forget_integral: whether the integral action's torque was of a motion that has ended.
    """

    share: float = 1.0
    track: bool = True
    obeyed: bool = True
    forget_disturbance: bool = False
    forget_integral: bool = False


REST = Order(share=0.0, track=False)
"""Brings the arm to rest."""
