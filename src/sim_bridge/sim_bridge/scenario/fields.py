# SPDX-License-Identifier: Apache-2.0
"""Checks of the entries of a scenario file; each error names the entry and what is allowed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from viability_bounds_pkg.exceptions import ArmSafetyError

_QUATERNION_TOLERANCE = 1e-3


class ScenarioError(ArmSafetyError, ValueError):
    """An invalid scenario file."""


class ScenarioEntry:
    """A mapping in a scenario file; its methods check and return the fields.

    Args:
        content: as read from the file.
        where: its place in the file, for errors; empty for the whole file.
        allowed: names of the fields it may have; None: any.

    Raises:
        ScenarioError: not a mapping, or it has other fields. The methods raise it for a field that
            is missing, malformed or out of range.
    """

    def __init__(self, content: Any, where: str, allowed: Sequence[str] | None = None) -> None:
        if not isinstance(content, dict):
            raise refuse(where, content, "fields and their values")
        unknown = [str(key) for key in content if allowed is not None and key not in allowed]
        if unknown:
            names = ", ".join(allowed or ())
            raise ScenarioError(f"{where} has {', '.join(unknown)}; allowed: {names}")
        self.fields, self.where = content, where

    def refuse(self, key: str, allowed: str) -> ScenarioError:
        """Return the error of an invalid field."""
        return refuse(f"{self.where}.{key}".lstrip("."), self.fields.get(key), allowed)

    def one_of(self, keys: Sequence[str]) -> str:
        """Return the only one of `keys` that is given; refuse none and several."""
        given = [key for key in keys if key in self.fields]
        if len(given) != 1:
            has = " and ".join(given) or "none of them"
            raise ScenarioError(
                f"{self.where} has {has}; allowed: exactly one of {', '.join(keys)}"
            )
        return given[0]

    def name(self, key: str, what: str) -> str:
        """Return a string that is not empty; `what` it stands for is part of the error."""
        value = self.fields.get(key)
        if not isinstance(value, str) or not value:
            raise self.refuse(key, what)
        return value

    def number(
        self, key: str, default: Any = None, *, zero: bool = False, negative: bool = False
    ) -> float:
        """Return a finite number; > 0 unless zero or negative ones are allowed."""
        value = self.fields.get(key, default)
        sign = "" if negative else " >= 0" if zero else " > 0"
        if (
            not _is_finite(value)
            or (value < 0 and not negative)
            or (value == 0 and not (zero or negative))
        ):
            raise self.refuse(key, f"a finite number{sign}")
        return float(value)

    def vector(self, key: str, size: int = 3, default: Any = None) -> tuple[float, ...]:
        """Return `size` finite numbers."""
        value = self.fields.get(key, default)
        if not isinstance(value, Sequence) or isinstance(value, str) or len(value) != size:
            raise self.refuse(key, f"{size} numbers")
        if not all(map(_is_finite, value)):
            raise self.refuse(key, f"{size} finite numbers")
        return tuple(map(float, value))

    def quaternion(self, key: str, default: Any = None) -> tuple[float, ...]:
        """Return a quaternion x, y, z, w of length one, which the field has nearly."""
        result = self.vector(key, 4, default)
        norm = math.hypot(*result)
        if abs(norm - 1.0) > _QUATERNION_TOLERANCE:
            raise ScenarioError(f"{self.where}.{key} has norm {norm:g}; allowed: 1 within 0.001")
        return tuple(component / norm for component in result)


def refuse(where: str, value: Any, allowed: str) -> ScenarioError:
    """Return the error of an invalid value."""
    return ScenarioError(f"{where} is {value!r}; allowed: {allowed}")


def _is_finite(value: Any) -> bool:
    """Return whether `value` is a number that a float can hold."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:
        return False
