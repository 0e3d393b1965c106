# SPDX-License-Identifier: Apache-2.0
"""Acceleration limits from messages: names matched, sizes, values and order checked."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence

import numpy as np
from trajectory_msgs.msg import JointTrajectory

from torque_safety_controller.qp import AccelerationRange
from viability_bounds_pkg.ros.runtime import stamp_to_ns


class LimitsReader:
    """Reads ``acceleration_limits`` into arrays in the order of `joints`.

    Args:
        joints: names of the n joints.
        warn: told in words when a message is dropped for a reason for the first time.

    Attributes:
        range: of the last accepted message, shape (n,) each, rad/s^2.
        stamp: of the state that they belong to, ns.
        refused: how many messages were dropped, by reason.
    """

    def __init__(self, joints: Sequence[str], warn: Callable[[str], object] | None = None) -> None:
        self._warn = warn
        self.range = AccelerationRange(np.zeros(len(joints)), np.zeros(len(joints)))
        self.stamp = -1
        self.refused: Counter[str] = Counter()
        self._joints = list(joints)

    def read(self, message: JointTrajectory) -> bool:
        """Take a message; return whether it was accepted."""
        if len(message.points) != 2:
            return self._refuse("wrong number of points")
        first, second = message.points
        lower, upper = np.array(first.accelerations), np.array(second.accelerations)
        if not len(lower) == len(upper) == len(message.joint_names):
            return self._refuse("wrong size")
        if message.joint_names != self._joints:
            where = {name: i for i, name in enumerate(message.joint_names)}
            if missing := next((joint for joint in self._joints if joint not in where), ""):
                return self._refuse("missing joint", f": there is no '{missing}'")
            index = [where[joint] for joint in self._joints]
            lower, upper = lower[index], upper[index]
        limits = AccelerationRange(lower, upper)
        if fault := limits.fault:
            return self._refuse(fault)
        self.range = limits
        self.stamp = stamp_to_ns(message.header.stamp)
        return True

    def _refuse(self, reason: str, detail: str = "") -> bool:
        self.refused[reason] += 1
        if self._warn is not None and self.refused[reason] == 1:
            self._warn(f"acceleration_limits refused: {reason}{detail}")
        return False
