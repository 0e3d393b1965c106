# SPDX-License-Identifier: Apache-2.0
"""Position, velocity and acceleration limits of joints, checked when they are made."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

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

    Instances are immutable and compare by identity, so that they can key a cache.

    Args:
        names: n different, non-empty joint names.
        q_min: shape (n,), rad, below `q_max`; -inf where there is no lower limit.
        q_max: shape (n,), rad; inf where there is no upper limit.
        v_max: shape (n,), rad/s, finite and positive; limits the speed in both directions.
        a_min: shape (n,), rad/s^2, finite and negative.
        a_max: shape (n,), rad/s^2, finite and positive.

    Raises:
        JointLimitsError: a value is missing, NaN, of the wrong sign, or out of order.
    """

    names: tuple[str, ...]
    q_min: NDArray[np.float64]
    q_max: NDArray[np.float64]
    v_max: NDArray[np.float64]
    a_min: NDArray[np.float64]
    a_max: NDArray[np.float64]

    def __post_init__(self) -> None:
        names = _checked_names(self.names)
        object.__setattr__(self, "names", names)
        for field in ("q_min", "q_max", "v_max", "a_min", "a_max"):
            object.__setattr__(self, field, joint_array(field, getattr(self, field), names))
        low, high = self.q_min, self.q_max
        for field, usable, allowed in (
            ("q_min", low < math.inf, "must be finite or -inf"),
            ("q_max", high > -math.inf, "must be finite or inf"),
            ("q_max", low < high, "must be above q_min"),
            ("v_max", _finite(self.v_max), "must be finite and positive"),
            ("a_min", _finite(-self.a_min), "must be finite and negative"),
            ("a_max", _finite(self.a_max), "must be finite and positive"),
        ):
            if not usable.all():
                j = int(np.argmin(usable))
                raise JointLimitsError(field, names[j], float(getattr(self, field)[j]), allowed)

    def __len__(self) -> int:
        return len(self.names)


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
