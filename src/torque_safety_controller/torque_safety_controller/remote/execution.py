# SPDX-License-Identifier: Apache-2.0
"""How far the execution of a trajectory has come, and whether it is near enough; no ROS."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from torque_safety_controller.driving.trajectory import JointTrajectory
from viability_bounds_pkg.state import State

Array = NDArray[np.float64]


class Progress(Enum):
    """Where an execution is."""

    MOVING = "it has not ended"
    REACHED = "the arm is at the end of the trajectory"
    OFF_PATH = "a joint is farther from the trajectory than is allowed on the way"
    NOT_REACHED = "the arm was not near enough to the end in time"


@dataclass(frozen=True, eq=False)
class Tolerances:
    """Allowed distances from a trajectory, shape (n,) each; inf for any."""

    position: Array
    """rad."""
    velocity: Array
    """rad/s."""

    def exceeded(self, joints: Sequence[str], q: Array, v: Array) -> str:
        """Return which joint is too far off, in words; empty if none is.

        Args:
            joints: their names.
            q: by how much the positions differ, shape (n,), rad.
            v: by how much the velocities differ, shape (n,), rad/s.
        """
        for off, allowed, unit in ((q, self.position, "rad"), (v, self.velocity, "rad/s")):
            over = np.abs(off) > allowed
            if over.any():
                k = int(np.argmax(np.where(over, np.abs(off) / allowed, 0.0)))
                return f"{joints[k]} is {off[k]:.3g} {unit} off; allowed: {allowed[k]:g}"
        return ""


@dataclass(eq=False)
class Execution:
    """Compares what the arm does with the trajectory that it was sent, by the states' stamps.

    Attributes:
        desired: positions, velocities and accelerations of the trajectory at the last state, shape
            (n,) each.
        off: desired less actual positions and velocities, shape (n,) each, rad and rad/s.
        why: what was too far off, in words.
    """

    joints: Sequence[str]
    """Names of the n joints."""
    trajectory: JointTrajectory
    """What is executed."""
    path: Tolerances
    """On the way."""
    goal: Tolerances
    """At the end."""
    patience: float
    """How long after the end of the trajectory the arm may be on its way, s."""
    begin: int = 0
    """Time 0 of the trajectory, ns; 0 for when it is sent."""
    continuous: NDArray[np.bool_] | None = None
    """Whether a joint turns without end, shape (n,); None for no joint."""
    desired: tuple[Array, Array, Array] = field(init=False)
    off: tuple[Array, Array] = field(init=False)
    why: str = field(init=False, default="")

    def start(self, state: State, stamp: int) -> None:
        """Start the trajectory from a state, at `stamp`, ns, as the controller does."""
        self.begin = self.begin or stamp
        self.trajectory = self.trajectory.from_state(state, self.continuous)

    def judge(self, state: State, stamp: int) -> Progress:
        """Judge a state of the arm with a stamp, ns."""
        t = 1e-9 * (stamp - self.begin)
        self.desired = self.trajectory.sample(t)
        self.off = self.desired[0] - state.q, self.desired[1] - state.v
        if t < 0.0:
            return Progress.MOVING
        if t < self.trajectory.duration:
            self.why = self.path.exceeded(self.joints, *self.off)
            return Progress.OFF_PATH if self.why else Progress.MOVING
        self.why = self.goal.exceeded(self.joints, *self.off)
        if not self.why:
            return Progress.REACHED
        over = t >= self.trajectory.duration + self.patience
        return Progress.NOT_REACHED if over else Progress.MOVING
