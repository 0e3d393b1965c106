# SPDX-License-Identifier: Apache-2.0
"""The numbers and stamps in messages of the streams, by field and joint, to be changed there."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

FIELDS = ("position", "velocity", "effort", "accelerations", "wrench")
"""Names of the fields of numbers: three of joint states and commands, the limits', a sensor's."""

_NS = 10**9


def fields_of(message: Any) -> Iterator[tuple[str, Array, Callable[[Array], None]]]:
    """Yield name, numbers and setter of each field of `message` that has numbers.

    Args:
        message: a JointState, a JointTrajectory or a WrenchStamped.
    """
    for name in ("position", "velocity", "effort"):
        if len(getattr(message, name, ())):
            yield name, np.array(getattr(message, name)), _setter(message, name)
    for point in getattr(message, "points", ()):
        if len(point.accelerations):
            yield "accelerations", np.array(point.accelerations), _setter(point, "accelerations")
    if hasattr(message, "wrench"):
        force, torque = message.wrench.force, message.wrench.torque
        numbers = np.array([force.x, force.y, force.z, torque.x, torque.y, torque.z])
        yield "wrench", numbers, lambda values: _set_wrench(message, values)


def joints_of(message: Any) -> list[str]:
    """Return the names of the joints, in the order of the numbers; none in a wrench."""
    return list(getattr(message, "name", ()) or getattr(message, "joint_names", ()))


def rename(message: Any) -> None:
    """Give the joints of a message names that no robot has; without joints, its frame."""
    for kind in ("name", "joint_names"):
        if hasattr(message, kind):
            setattr(message, kind, [f"{joint}_" for joint in getattr(message, kind)])
            return
    message.header.frame_id += "_"


def stamp_of(message: Any) -> int:
    """Return the stamp of a message, ns."""
    return int(message.header.stamp.sec) * _NS + int(message.header.stamp.nanosec)


def set_stamp(message: Any, stamp: int) -> None:
    """Give a message a stamp, ns; times before zero become zero."""
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(max(stamp, 0), _NS)


def _setter(part: Any, name: str) -> Callable[[Array], None]:
    return lambda values: setattr(part, name, values.tolist())


def _set_wrench(message: Any, values: Array) -> None:
    force, torque = message.wrench.force, message.wrench.torque
    parts = force, force, force, torque, torque, torque
    for part, axis, value in zip(parts, "xyzxyz", values.tolist(), strict=False):
        setattr(part, axis, value)
