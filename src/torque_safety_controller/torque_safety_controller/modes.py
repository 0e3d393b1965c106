# SPDX-License-Identifier: Apache-2.0
"""Modes of the controller, and what they follow from; `docs/reference/topics.md` shows both."""

from __future__ import annotations

from enum import Enum
from typing import NamedTuple

CONTROLS = ("torque", "position")
"""Kinds of commands to the robot's drives."""


class Mode(Enum):
    """Mode of the controller."""

    TRACKING = "TRACKING"
    """Follows its goals inside all limits."""
    HOLD = "HOLD"
    """Brings the arm to rest: gravity compensation and damping inside the torque limits."""
    POSITION = "POSITION"
    """The robot's own position control holds the position that it is sent."""
    STOPPED = "STOPPED"
    """Publishes nothing; the robot's own watchdog brakes it."""


class Control(Enum):
    """Which control commands the joints."""

    TORQUE = "torque"
    POSITION = "position"
    """The drives hold the positions that they are sent."""
    TAKING_OVER = "taking over"
    """Still position control, until the torque of the motors is known."""
    GIVING_BACK = "giving back"
    """Still torque control, which brings the arm to rest."""


class Goals(Enum):
    """What becomes of the goals."""

    KEPT = "as before"
    ASIDE = "not served meanwhile"
    SLOWED = "share 0, until the arm rests"
    FALLING = "share falls to 0, until the arm rests"


class Cause(NamedTuple):
    """Why the controller does not simply follow its goals: a row of `CAUSES`.

    Attributes:
        event: that begins it.
        ends: what ends it.
        mode: meanwhile; None for the one that it would be without.
        goals: what becomes of them.
        reason: as reported; empty where it comes with the event.
    """

    event: str
    ends: str
    mode: Mode | None
    goals: Goals
    reason: str = ""


CAUSES = {
    "silent": Cause(
        "no joint state for 1.5 bounds_timeout, or no usable one for state_timeout",
        "a usable one",
        Mode.STOPPED,
        Goals.KEPT,
    ),
    "refused": Cause(
        "three joint states in a row cannot be used",
        "a usable one",
        Mode.STOPPED,
        Goals.SLOWED,
    ),
    "drives": Cause(
        "position control, at start or by enable_torque",
        "torque control",
        Mode.POSITION,
        Goals.KEPT,
    ),
    "failed": Cause("the QP has no solution", "it has one", Mode.HOLD, Goals.SLOWED),
    "stale": Cause(
        "a state has waited for its limits for bounds_timeout",
        "limits come with their state",
        Mode.HOLD,
        Goals.SLOWED,
        "acceleration limits are stale",
    ),
    "giving back": Cause(
        "enable_torque: false",
        "the arm is at rest, or 2 s",
        Mode.HOLD,
        Goals.ASIDE,
        "on the way to position control",
    ),
    "no plan": Cause(
        "safety_filter knows no plan that keeps all limits",
        "it knows one",
        Mode.HOLD,
        Goals.KEPT,
        "no plan within all limits is known",
    ),
    "rival": Cause(
        "a goal comes while several nodes publish goals",
        "one of them is left",
        Mode.HOLD,
        Goals.SLOWED,
        "several nodes publish goals",
    ),
    "moved": Cause(
        "a locked joint before the hand moves, at 0.05 rad/s or m/s or more",
        "it has been slower for 0.5 s",
        Mode.HOLD,
        Goals.SLOWED,
    ),
    "no goal": Cause("there is no goal", "a goal", Mode.HOLD, Goals.ASIDE, "no goal"),
    "moves": Cause(
        "one of the above has set the share to 0; states were missing, or not answered for "
        "bounds_timeout; the motors held the arm before",
        "the arm is at rest, or 1 s",
        Mode.HOLD,
        Goals.SLOWED,
    ),
    "missed": Cause(
        "more states in a row without an answer than the bounds cover",
        "the next state",
        None,
        Goals.FALLING,
    ),
    "ignored": Cause(
        "the torques of three states in a row are not those that were sent",
        "they are",
        None,
        Goals.FALLING,
        "the motors do not give the torques that were sent",
    ),
}
"""What keeps the controller from following its goals. The first that lasts gives the mode; without
one it is TRACKING."""

CHANGES = {
    (Control.POSITION, "enable"): Control.TAKING_OVER,
    (Control.TAKING_OVER, "torque known"): Control.TORQUE,
    (Control.TAKING_OVER, "failed"): Control.POSITION,
    (Control.TAKING_OVER, "disable"): Control.POSITION,
    (Control.TAKING_OVER, "away"): Control.POSITION,
    (Control.TORQUE, "disable"): Control.GIVING_BACK,
    (Control.GIVING_BACK, "enable"): Control.TORQUE,
    (Control.GIVING_BACK, "at rest"): Control.POSITION,
    (Control.GIVING_BACK, "away"): Control.POSITION,
}
"""Changes of control by event; others change nothing. A robot that was away goes back from
torque to position control as well, where it has started so."""
