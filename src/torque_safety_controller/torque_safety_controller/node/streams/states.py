# SPDX-License-Identifier: Apache-2.0
"""The stream of joint states: which can be used, which were answered, where it begins anew."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from enum import Enum
from typing import Any

import numpy as np
from sensor_msgs.msg import JointState

from viability_bounds_pkg.ros.messages import JointStateReader, Verdict
from viability_bounds_pkg.state_estimation.state_check import RESTART, STAYS, StateCheck

UNSEEN = 3
"""States in a row that cannot be used after which nothing is known of the arm."""


class Arrival(Enum):
    """What a joint state is to those who answer it."""

    NEXT = 1
    """A new state of an arm that goes on."""
    ANEW = 2
    """The first state of an arm that was silent, or of a robot that has restarted."""
    BACK = 3
    """The last state, repeated by an arm that was silent."""
    REPEAT = 4
    """The last state, repeated: this was lost, or its answer."""
    REFUSED = 5
    """Dropped and counted."""
    UNDECIDED = 6
    """The next state tells whether it is wrong."""


class StateStream(JointStateReader):
    """Joint states as they come and are answered, in the order of `joints`.

    Args:
        joints: names of the n joints.
        timeout: how long without a usable state until the arm counts as silent, s.
        warn: told in words when a state is dropped for a reason for the first time.
        check: tells states that cannot be; None to believe what is finite.

    A state that is undecided counts as one that was lost, until the next one.

    Attributes:
        message_at: when the last message came, usable or not, s on the steady clock.
        message_stamp: its stamp, as in messages.
        usable_at: when the last usable one came, s.
        waiting_since: since when there is a state to answer, s.
        answered_stamp: of the state answered last, ns; -1 if there is none since it began.
        refused_in_row: states dropped since the last usable one, of an arm that is answered.
        missed: whether states of the arm that was answered were missing before the last one.
        unseen: whether the arm may have been put elsewhere before the last one: stamps have leapt
            as after a start of the robot, or `UNSEEN` states were dropped.
    """

    LEAVES_UNDECIDED = True

    def __init__(
        self,
        joints: Sequence[str],
        timeout: float,
        warn: Callable[[str], object] | None = None,
        check: StateCheck | None = None,
    ) -> None:
        super().__init__(joints, timeout, warn, check)
        self._timeout = timeout
        self.message_at = self.usable_at = self.waiting_since = -math.inf
        self.message_stamp: Any = None
        self.answered_stamp = -1
        self.refused_in_row = 0
        self.missed = self.unseen = False

    def take(self, message: JointState, now: float) -> Arrival:
        """Take a message that arrived at `now`, in s on the steady clock."""
        self.message_at, self.message_stamp = now, message.header.stamp
        last, was_at = self.stamp, self.q
        verdict = self.read(message, now)
        if verdict is not Verdict.NEW and verdict is not Verdict.REPEAT:
            return Arrival.REFUSED if verdict is Verdict.REFUSED else Arrival.UNDECIDED
        dropped, self.refused_in_row = self.refused_in_row, 0
        silent = self.silent(now)
        self.usable_at = now
        self.missed = silent and 0 <= self.answered_stamp <= last < self.stamp
        if verdict is not Verdict.NEW:
            return Arrival.BACK if silent else Arrival.REPEAT
        if last >= 0:  # where its time stood still, as of a halted simulation, the arm did, too
            silent = silent and self.stamp - last > 1e9 * self._timeout
        # Where the time alone has leapt, the arm goes on without a jolt.
        leapt = self.stamp - last >= 1e9 * RESTART
        self.unseen = leapt or dropped >= UNSEEN
        elsewhere = leapt and bool((np.abs(self.q - was_at) > STAYS).any())
        if silent or self.stamp <= last or elsewhere:
            return Arrival.ANEW
        if self.answered_stamp == last:
            self.waiting_since = now
        return Arrival.NEXT

    def count_refused(self) -> int:
        """Count a dropped state of an arm that is answered; return how many in a row."""
        self.refused_in_row += 1
        return self.refused_in_row

    def answered(self) -> None:
        """Count the last state as answered."""
        self.answered_stamp = self.stamp

    def begin(self) -> None:
        """Count from the last usable state on: nothing before it was answered."""
        self.answered_stamp = -1
        self.waiting_since = self.usable_at

    def silent(self, now: float) -> bool:
        """Return whether no usable state has come for longer than the time-out."""
        return now - self.usable_at > self._timeout

    def waits(self, now: float) -> float:
        """Return for how long the last state has waited for its answer, s; 0 if it does not."""
        if self.stamp == self.answered_stamp or self.refused_in_row:
            return 0.0
        return now - self.waiting_since

    def elapsed(self) -> float | None:
        """Return the time since the state answered last, s; None if there is none."""
        if self.answered_stamp < 0:
            return None
        return 1e-9 * (self.stamp - self.answered_stamp)

    @property
    def why_refused(self) -> str:
        """Why states were dropped since the start, in words."""
        return "joint states are refused: " + ", ".join(self.refused)
