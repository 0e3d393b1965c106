# SPDX-License-Identifier: Apache-2.0
"""The torque that the motors gave: that of a command, or where none explains it, the reported one.

A command has no noise, but may have been lost; the reported effort decides. See
`docs/theory/estimator.md`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from viability_bounds_pkg.state import State
from viability_bounds_pkg.state_estimation.prediction import ForwardModel, MotorLag

Array = NDArray[np.float64]

MAX_TOLERANCE, MIN_TOLERANCE = 0.1, 0.03
"""Difference between effort and command from which the effort is used, in torque limits, root sum
square over the joints: brakes, or drives that stop by themselves. In between by its noise."""

NOISE_FACTOR, NOISE_PERIODS = 3.0, 100
"""That difference in root mean squares of what it was in so many periods of obeyed commands."""

EXCESS_KEPT = 0.98
"""Part of the torque in excess of obeyed commands that is left after a period."""


class MotorTorque:
    """Follows the torque of the motors from period to period.

    Args:
        model: tells the torque that holds an arm.
        lag: of the motors.
        torque_max: torque limits, shape (n,), N m.

    Attributes:
        tau: torque at the instant of the last state, shape (n,), N m.
        excess: what the motors give beyond the commands, as far as those were not obeyed, shape
            (n,), N m; None before that is known.
    """

    def __init__(self, model: ForwardModel, lag: MotorLag, torque_max: Array) -> None:
        self._model, self._lag, self._torque_share = model, lag, 1.0 / torque_max
        self._noise = (MAX_TOLERANCE / NOISE_FACTOR) ** 2  # mean square
        self.tau = np.zeros(torque_max.size)
        self.excess: Array | None = None
        self._acting: Array | None = None  # the command that acts

    def start(self, reported: State, effort: Array | None) -> None:
        """Restart at a reported state, shape (n,), with its effort, shape (n,), N m."""
        self.excess = self._acting = None
        self.tau = self._without_commands(reported, effort)

    def update(self, command: Array | None, reported: State, effort: Array | None) -> None:
        """Advance by a period.

        Args:
            command: that should have acted in it, shape (n,), N m; None for none.
            reported: state at its end.
            effort: reported with it, shape (n,), N m; None where there is none.
        """
        kept, self._acting = self._acting, command
        if command is None:
            self.excess = None
            self.tau = self._without_commands(reported, effort)
        elif effort is None:
            self.excess = None
            self.tau = self._lag.end(self.tau, command)
        else:
            self.tau = self._from_effort(command, kept, effort)

    def _from_effort(self, command: Array, kept: Array | None, effort: Array) -> Array:
        """Return the torque now, where effort and command are known, shape (n,), N m."""
        before, excess = self.tau, self.excess
        off = self._distance(effort, self._lag.end(before, command))
        if kept is not None and kept is not command:
            unchanged = self._distance(effort, self._lag.end(before, kept))
            if unchanged < off:  # the command was lost
                off, command = unchanged, kept
                self._acting = kept
        more, tolerance = effort - command, MIN_TOLERANCE**2
        if excess is not None:
            tolerance = min(MAX_TOLERANCE**2, max(tolerance, NOISE_FACTOR**2 * self._noise))
        if off >= tolerance:
            self.excess = more
            return effort
        if excess is None:  # the torque before is not that of a command
            self.excess = np.zeros_like(effort)
            return effort
        self._noise += (off - self._noise) / NOISE_PERIODS
        # A robot that has stopped itself resumes little by little, and what friction holds
        # meanwhile was learned with its torques.
        least, most = np.minimum(more, 0.0), np.maximum(more, 0.0)
        self.excess = np.minimum(np.maximum(EXCESS_KEPT * excess, least), most)
        return self._lag.end(before, command + self.excess)

    def _without_commands(self, reported: State, effort: Array | None) -> Array:
        """Return the torque of a robot that moves or holds itself, shape (n,), N m.

        Where its motors give hardly any, brakes hold it, whose torque is in no effort: then the
        joints are taken to keep their velocity.
        """
        if effort is None or self._distance(effort, np.zeros(len(effort))) < MIN_TOLERANCE**2:
            return self._model.torque_at(reported)
        return effort

    def _distance(self, effort: Array, expected: Array) -> float:
        share = self._torque_share * (effort - expected)
        return float(share @ share)
