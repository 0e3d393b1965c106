"""Checks of the entries of a scenario file; each error names the entry and what is allowed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from viability_bounds_pkg.exceptions import ArmSafetyError

Fields = dict[str, Any]

_QUATERNION_TOLERANCE = 1e-3


class ScenarioError(ArmSafetyError, ValueError):
    """An invalid scenario file."""


def refuse(where: str, value: Any, allowed: str) -> ScenarioError:
    """Return the error of an entry with an invalid value."""
    return ScenarioError(f"{where} is {value!r}; allowed: {allowed}")


def only(fields: Fields, allowed: Sequence[str], where: str) -> None:
    """Refuse fields that are not `allowed`."""
    unknown = [str(key) for key in fields if key not in allowed]
    if unknown:
        raise ScenarioError(f"{where} has {', '.join(unknown)}; allowed: {', '.join(allowed)}")


def one_of(fields: Fields, keys: Sequence[str], where: str) -> str:
    """Return the only one of `keys` that is given; refuse none and several."""
    given = [key for key in keys if key in fields]
    if len(given) != 1:
        has = " and ".join(given) or "none of them"
        raise ScenarioError(f"{where} has {has}; allowed: exactly one of {', '.join(keys)}")
    return given[0]


def name(value: Any, where: str, what: str) -> str:
    """Return a string that is not empty; `what` it stands for is part of the error."""
    if not isinstance(value, str) or not value:
        raise refuse(where, value, what)
    return value


def number(value: Any, where: str, *, zero: bool = False, negative: bool = False) -> float:
    """Return a finite number; > 0 unless zero or negative ones are allowed."""
    sign = "" if negative else " >= 0" if zero else " > 0"
    if (
        not _is_finite(value)
        or (value < 0 and not negative)
        or (value == 0 and not (zero or negative))
    ):
        raise refuse(where, value, f"a finite number{sign}")
    return float(value)


def vector(value: Any, size: int, where: str) -> tuple[float, ...]:
    """Return `size` finite numbers."""
    if not isinstance(value, Sequence) or isinstance(value, str) or len(value) != size:
        raise refuse(where, value, f"{size} numbers")
    if not all(map(_is_finite, value)):
        raise refuse(where, value, f"{size} finite numbers")
    return tuple(map(float, value))


def quaternion(value: Any, where: str) -> tuple[float, ...]:
    """Return a quaternion x, y, z, w of length one, which the entry has nearly."""
    result = vector(value, 4, where)
    norm = math.hypot(*result)
    if abs(norm - 1.0) > _QUATERNION_TOLERANCE:
        raise ScenarioError(f"{where} has norm {norm:g}; allowed: 1 within 0.001")
    return tuple(component / norm for component in result)


def _is_finite(value: Any) -> bool:
    """Return whether `value` is a number that a float can hold."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:
        return False
