# SPDX-License-Identifier: Apache-2.0
"""Position, velocity and acceleration limits of joints, checked when they are made."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields

import numpy as np
from numpy.typing import ArrayLike, NDArray

from viability_bounds_pkg.exceptions import ArmSafetyError

ROUNDING = 64.0 * float(np.finfo(np.float64).eps)
"""Relative tolerance for numbers that are equal but for rounding."""


class JointLimitsError(ArmSafetyError, ValueError):
    """A joint limit, or a setting that depends on one, is unusable.

    Attributes:
        field: name of the offending argument.
        joint: name of the joint, or None when the whole argument is at fault.
        value: what was given.
        allowed: what would have been accepted.
    """

    def __init__(self, field: str, joint: str | None, value: object, allowed: str) -> None:
        self.field = field
        self.joint = joint
        self.value = value
        self.allowed = allowed
        where = field if joint is None else f"{field} of joint {joint!r}"
        super().__init__(f"{where} is {value}; {allowed}")


@dataclass(frozen=True, eq=False)
class JointLimits:
    """Position, velocity and acceleration limits of n joints.

    Towards a position limit at distance r the speed is limited to

        min(v_max, max(0, sqrt(2 d r) - c)),

    d being `deceleration_limit`, c `velocity_offset`. So a joint stands at a distance of
    ``c^2 / (2 d)`` at the latest; nearer to the limit it may only move away. Instances are
    immutable and compare by identity, so that they can key a cache.

    Args:
        names: n different, non-empty joint names.
        q_min: shape (n,), rad, below `q_max`; -inf where there is no lower limit.
        q_max: shape (n,), rad; inf where there is no upper limit.
        v_max: shape (n,), rad/s, finite and positive; limits the speed in both directions.
        a_min: shape (n,), rad/s^2, finite and negative.
        a_max: shape (n,), rad/s^2, finite and positive.
        velocity_offset: shape (n,), rad/s, not negative; zeros if empty.
        deceleration_limit: shape (n,), rad/s^2, positive; inf, as for all if empty, for a speed
            limit that does not depend on position.

    Raises:
        JointLimitsError: a value is missing, NaN, of the wrong sign, or out of order; or the
            speed limit leaves no place to move.
    """

    names: tuple[str, ...]
    q_min: NDArray[np.float64]
    q_max: NDArray[np.float64]
    v_max: NDArray[np.float64]
    a_min: NDArray[np.float64]
    a_max: NDArray[np.float64]
    velocity_offset: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    deceleration_limit: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        names = _checked_names(self.names)
        object.__setattr__(self, "names", names)
        for name, none in (("velocity_offset", 0.0), ("deceleration_limit", np.inf)):
            if np.size(getattr(self, name)) == 0:
                object.__setattr__(self, name, np.full(len(names), none))
        for name in (each.name for each in fields(self)[1:]):
            object.__setattr__(self, name, joint_array(name, getattr(self, name), names))
        low, high, c, d = self.q_min, self.q_max, self.velocity_offset, self.deceleration_limit
        with np.errstate(invalid="ignore"):  # of numbers that are refused
            moves = c * c < d * (high - low)
        for name, usable, allowed in (
            ("q_min", low < math.inf, "must be finite or -inf"),
            ("q_max", high > -math.inf, "must be finite or inf"),
            ("q_max", low < high, "must be above q_min"),
            ("v_max", _finite(self.v_max), "must be finite and positive"),
            ("a_min", _finite(-self.a_min), "must be finite and negative"),
            ("a_max", _finite(self.a_max), "must be finite and positive"),
            ("deceleration_limit", d > 0.0, "must be positive, or inf for none"),
            ("velocity_offset", (c >= 0.0) & (c < math.inf), "must be finite and at least 0"),
            ("velocity_offset", (c == 0.0) | (d < math.inf), "needs a finite deceleration_limit"),
            (
                "velocity_offset",
                moves,
                "must be smaller, or deceleration_limit larger: nowhere in the position range "
                "may the joint move",
            ),
        ):
            if not usable.all():
                j = int(np.argmin(usable))
                raise JointLimitsError(name, names[j], float(getattr(self, name)[j]), allowed)

    def __len__(self) -> int:
        return len(self.names)

    @property
    def rest_distance(self) -> NDArray[np.float64]:
        """Distance to a position limit within which joints may only move away, shape (n,), rad."""
        distance: NDArray[np.float64] = 0.5 * self.velocity_offset**2 / self.deceleration_limit
        return distance

    def velocities(self, q: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the lowest and the highest velocity that is allowed at positions `q`.

        Args:
            q: shape (..., n), rad.

        Returns:
            Two arrays of the shape of `q`, rad/s.
        """
        at = np.asarray(q, dtype=np.float64)
        rooms = np.stack([at - self.q_min, self.q_max - at])
        lower, upper = speed_limits(
            rooms, self.v_max, self.velocity_offset, self.deceleration_limit
        )
        return -lower, upper


def speed_limits(
    rooms: NDArray[np.float64],
    v_max: NDArray[np.float64],
    velocity_offset: NDArray[np.float64],
    deceleration_limit: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return the speed limits at distances to a position limit.

    Args:
        rooms: the distances, shape (..., n), rad.
        v_max: shape (n,), rad/s.
        velocity_offset: as in `JointLimits`, shape (n,), rad/s.
        deceleration_limit: as in `JointLimits`, shape (n,), rad/s^2.

    Returns:
        Shape (..., n), rad/s.
    """
    none = np.isinf(deceleration_limit)
    if none.all():
        return np.broadcast_to(v_max, rooms.shape)
    with np.errstate(invalid="ignore"):
        curve = np.sqrt(2.0 * deceleration_limit * np.maximum(rooms, 0.0)) - velocity_offset
    return np.where(none, v_max, np.minimum(np.maximum(curve, 0.0), v_max))


def joint_array(field: str, values: ArrayLike, names: Sequence[str]) -> NDArray[np.float64]:
    """Return `values` as a read-only float64 array of one value per joint.

    Args:
        field: what the values are called in an error message.
        values: n numbers, none of them NaN.
        names: the n joint names.

    Raises:
        JointLimitsError: not numbers, not n of them, or NaN.
    """
    try:
        array = np.array(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise JointLimitsError(field, None, values, "must be a list of numbers") from None
    if array.shape != (len(names),):
        shape = "x".join(map(str, array.shape)) or "a single number"
        allowed = f"must have one value for each of the {len(names)} joints"
        raise JointLimitsError(field, None, f"of shape {shape}", allowed)
    for name, value in zip(names, array, strict=True):
        if math.isnan(value):
            raise JointLimitsError(field, name, "nan", "must be a number")
    array.flags.writeable = False
    return array


def _checked_names(names: Sequence[str]) -> tuple[str, ...]:
    if isinstance(names, str):
        raise JointLimitsError("names", None, repr(names), "must be a list of joint names")
    result = tuple(names)
    if not result:
        raise JointLimitsError("names", None, "empty", "must name at least one joint")
    for name in result:
        if not isinstance(name, str) or not name:
            raise JointLimitsError("names", None, repr(name), "must be non-empty strings")
        if result.count(name) > 1:
            raise JointLimitsError("names", name, "given twice", "must be different")
    return result


def _finite(values: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which values are finite and positive."""
    return np.isfinite(values) & (values > 0.0)
