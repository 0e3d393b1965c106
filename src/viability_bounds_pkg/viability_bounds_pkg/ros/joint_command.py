# SPDX-License-Identifier: Apache-2.0
"""The command of a ``joint_commands`` message."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import JointState

from viability_bounds_pkg.exceptions import ArmSafetyError

Array = NDArray[np.float64]


class CommandError(ArmSafetyError, ValueError):
    """An invalid command; the text is the reason, in a few words."""


class TorqueCommand(NamedTuple):
    """Torques for the motors, shape (n,), N m."""

    tau: Array


class PositionCommand(NamedTuple):
    """Desired positions, rad, and velocities, rad/s, of the drives, shape (n,) each."""

    q: Array
    v: Array


JointCommand = TorqueCommand | PositionCommand


def read_command(message: JointState, joints: Sequence[str]) -> JointCommand:
    """Return the command for `joints`; further joints in the message are ignored.

    With efforts it is a torque command, and positions and velocities are ignored. Without efforts
    it is a position command; missing velocities are zero.

    Raises:
        CommandError: sizes do not match, a joint is missing, a number is not finite.
    """
    if len(message.effort):
        return TorqueCommand(_in_order(message, message.effort, joints))
    velocity = message.velocity or [0.0] * len(message.name)
    q, v = (_in_order(message, values, joints) for values in (message.position, velocity))
    return PositionCommand(q, v)


def accept_command(
    message: JointState,
    joints: Sequence[str],
    refused: Counter[str],
    warn: Callable[[str], object],
) -> JointCommand | None:
    """Return the command in a message, None if it is invalid; the first one of a kind is logged.

    Args:
        message: that has come.
        joints: as for `read_command`.
        refused: counts invalid commands by reason.
        warn: logs.
    """
    try:
        return read_command(message, joints)
    except CommandError as error:
        refused[str(error)] += 1
        if refused[str(error)] == 1:
            warn(f"joint_commands refused: {error}")
        return None


def _in_order(message: JointState, values: list[float], joints: Sequence[str]) -> Array:
    """Return the `values` of `joints`, shape (n,)."""
    if len(values) != len(message.name):
        raise CommandError("wrong size")
    if message.name != joints:
        where = dict(zip(message.name, values, strict=True))
        if any(joint not in where for joint in joints):
            raise CommandError("missing joint")
        values = [where[joint] for joint in joints]
    array = np.array(values)
    if not np.isfinite(array).all():
        raise CommandError("not finite")
    return array
