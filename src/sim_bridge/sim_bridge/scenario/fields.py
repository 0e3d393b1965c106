"""Checks of what a scenario file says; each refusal names the entry and what is allowed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from viability_bounds_pkg.exceptions import ArmSafetyError

_QUATERNION_TOLERANCE = 1e-3


class ScenarioError(ArmSafetyError, ValueError):
    """A scenario file that cannot be played."""


def refuse(where: str, value: Any, allowed: str) -> ScenarioError:
    """Return the error of an entry that has a value that it may not have."""
    return ScenarioError(f"{where} is {value!r}; allowed: {allowed}")


def only(fields: dict, allowed: Sequence[str], where: str) -> None:
    """Refuse fields that are not `allowed`."""
    unknown = [str(key) for key in fields if key not in allowed]
    if unknown:
        raise ScenarioError(f"{where} has {', '.join(unknown)}; allowed: {', '.join(allowed)}")


def one_of(fields: dict, keys: Sequence[str], where: str) -> str:
    """Return which one of `keys` is given; refuse none and several."""
    given = [key for key in keys if key in fields]
    if len(given) != 1:
        has = " and ".join(given) or "none of them"
        raise ScenarioError(f"{where} has {has}; allowed: exactly one of {', '.join(keys)}")
    return given[0]


def name(value: Any, where: str, what: str) -> str:
    """Return a string that is not empty; `what` it names is said when it is not."""
    if not isinstance(value, str) or not value:
        raise refuse(where, value, what)
    return value


def number(value: Any, where: str, *, zero: bool = False, negative: bool = False) -> float:
    """Return a finite number, > 0 unless told otherwise."""
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
    """Return a unit quaternion x, y, z, w."""
    result = vector(value, 4, where)
    norm = math.hypot(*result)
    if abs(norm - 1.0) > _QUATERNION_TOLERANCE:
        raise ScenarioError(f"{where} has norm {norm:g}; allowed: 1 within 0.001")
    return result


def _is_finite(value: Any) -> bool:
    """Return whether `value` is a number that a float can hold."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:
        return False
