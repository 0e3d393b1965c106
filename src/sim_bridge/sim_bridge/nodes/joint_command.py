"""What a ``joint_commands`` message asks a robot for."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import JointState

from viability_bounds_pkg.exceptions import ArmSafetyError

Array = NDArray[np.float64]


class CommandError(ArmSafetyError, ValueError):
    """A command that cannot be obeyed; its text is the reason, in a few words."""


class TorqueCommand(NamedTuple):
    """Torques for the motors, shape (n,), N m."""

    tau: Array

    control = "torque"


class PositionCommand(NamedTuple):
    """Where the drives are to be, rad, and how fast to pass there, rad/s; shape (n,) each."""

    q: Array
    v: Array

    control = "position"


JointCommand = TorqueCommand | PositionCommand


def read_command(message: JointState, joints: list[str]) -> JointCommand:
    """Return what `message` asks of `joints`; further joints in it are ignored.

    Efforts make it a torque command, whatever else it says. Without, positions make it a position
    command; velocities may be left out and are zero then.

    Raises:
        CommandError: sizes do not match, a joint is missing, a number is not finite.
    """
    if len(message.effort):
        return TorqueCommand(_in_order(message, message.effort, joints))
    q = _in_order(message, message.position, joints)
    if not len(message.velocity):
        return PositionCommand(q, np.zeros(len(joints)))
    return PositionCommand(q, _in_order(message, message.velocity, joints))


def _in_order(message: JointState, values: list[float], joints: list[str]) -> Array:
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
