# SPDX-License-Identifier: Apache-2.0
"""Checks of the entries of a scenario file; each error names the entry and what is allowed."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping
from functools import partial
from typing import Any

from viability_bounds_pkg.exceptions import ArmSafetyError, did_you_mean
from viability_bounds_pkg.parameter import FINITE, NOT_NEGATIVE, POSITIVE, Range

_QUATERNION_TOLERANCE = 1e-3


class ScenarioError(ArmSafetyError, ValueError):
    """An invalid scenario file."""


Check = Callable[[Any, str], Any]
"""Takes a value and its place in the file; returns it checked, or raises `ScenarioError`."""


def read_fields(
    content: Any, where: str, checks: Mapping[str, Check], optional: Collection[str] = ()
) -> dict[str, Any]:
    """Return the checked fields of a mapping, by name.

    Args:
        content: as read from the file.
        where: its place in the file, for errors; empty for the whole file.
        checks: of the fields that it may have.
        optional: fields that may be left out, and are left out of the result then.

    Raises:
        ScenarioError: it is no mapping, has other fields, or a field is missing, malformed or out
            of range.
    """
    if not isinstance(content, dict):
        raise refuse(where or "the file", content, "fields and their values")
    unknown = [str(key) for key in content if key not in checks]
    if unknown:
        place, names = where or "the file", ", ".join(checks)
        hint = did_you_mean(unknown[0], checks)
        raise ScenarioError(f"{place} has {', '.join(unknown)}; allowed: {names}{hint}")
    return {
        key: check(content.get(key), f"{where}.{key}".lstrip("."))
        for key, check in checks.items()
        if key in content or key not in optional
    }


def one_of(keys: Collection[str], content: Mapping[str, Any], where: str) -> str:
    """Return the only one of `keys` that is given; refuse none and several."""
    given = [key for key in keys if key in content]
    if len(given) != 1:
        has = " and ".join(given) or "none of them"
        raise ScenarioError(f"{where} has {has}; allowed: exactly one of {', '.join(keys)}")
    return given[0]


def refuse(where: str, value: Any, allowed: str) -> ScenarioError:
    """Return the error of an invalid value."""
    return ScenarioError(f"{where} is {value!r}; allowed: {allowed}")


def name(value: Any, where: str) -> str:
    """Check a string that is not empty."""
    if not isinstance(value, str) or not value:
        raise refuse(where, value, "a name")
    return value


def number(value: Any, where: str, allowed: Range = FINITE) -> float:
    """Check a finite number in a range."""
    if not _is_finite(value) or value not in allowed:
        raise refuse(where, value, f"a finite number {allowed}".strip())
    return float(value)


not_negative = partial(number, allowed=NOT_NEGATIVE)
positive = partial(number, allowed=POSITIVE)


def vector(value: Any, where: str, size: int = 3) -> tuple[float, ...]:
    """Check `size` finite numbers."""
    if not isinstance(value, list) or len(value) != size or not all(map(_is_finite, value)):
        raise refuse(where, value, f"{size} finite numbers")
    return tuple(map(float, value))


def quaternion(value: Any, where: str) -> tuple[float, ...]:
    """Check a quaternion x, y, z, w of about length one; return it with that length."""
    result = vector(value, where, 4)
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
