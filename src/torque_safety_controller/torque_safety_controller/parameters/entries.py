# SPDX-License-Identifier: Apache-2.0
"""List entries that are YAML mappings, as "{name: wall, shape: box, size: [0.1, 1.0, 1.0]}"."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from viability_bounds_pkg.exceptions import SettingError
from viability_bounds_pkg.parameter import FINITE, Range

Array = NDArray[np.float64]


class Entry:
    """One entry of a parameter that is a list of strings.

    Args:
        parameter: its name.
        index: of the entry.
        text: the entry, a YAML mapping in flow style.
        fields: names of all fields that it may have.

    Raises:
        SettingError: it is no mapping, or has another field.
    """

    def __init__(self, parameter: str, index: int, text: str, fields: Sequence[str]) -> None:
        self._label = f"{parameter}[{index}]"
        try:
            self._values = yaml.safe_load(text)
        except yaml.YAMLError:
            self._values = None
        if not isinstance(self._values, dict) or not set(self._values) <= set(fields):
            allowed = f"a YAML mapping with the fields {', '.join(fields)}"
            raise SettingError(self._label, text, allowed)

    def refused(self, field: str, allowed: str) -> SettingError:
        """Return the error that a field is not what is allowed."""
        return SettingError(f"{self._label}.{field}", self._values.get(field), allowed)

    def text(self, field: str) -> str:
        """Return a string that is not empty.

        Raises:
            SettingError: it is missing or something else.
        """
        value = self._values.get(field)
        if not isinstance(value, str) or not value:
            raise self.refused(field, "a string")
        return value

    def number(self, field: str, default: float, within: Range) -> float:
        """Return a number, or `default` where it is missing.

        Raises:
            SettingError: it is something else, or out of range.
        """
        value = _number(self._values.get(field, default))
        if value not in within:
            raise self.refused(field, f"a finite number {within}")
        return value

    def vector(
        self, field: str, default: Sequence[float] | None = None, within: Range = FINITE
    ) -> Array:
        """Return three numbers, shape (3,), or `default` where they are missing.

        Raises:
            SettingError: they are missing and there is no default, something else, or out of
                range.
        """
        value = self._values.get(field, default)
        numbers = list(map(_number, value)) if isinstance(value, list | tuple) else []
        if len(numbers) != 3 or not all(number in within for number in numbers):
            raise self.refused(field, f"3 finite numbers {within}".strip())
        return np.array(numbers)


def _number(value: Any) -> float:
    """Return a number, NaN if it is none; YAML takes 1e-3 for a string."""
    try:
        return float("nan") if isinstance(value, bool) else float(value)
    except (TypeError, ValueError):
        return float("nan")
