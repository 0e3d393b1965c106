# SPDX-License-Identifier: Apache-2.0
"""The errors that this project raises on purpose."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any


class ArmSafetyError(Exception):
    """Base class of all errors that this project raises on purpose."""


class SettingError(ArmSafetyError, ValueError):
    """A setting or parameter that cannot be used.

    Args:
        name: of the setting.
        value: what it was set to; None if it was not.
        allowed: what it may be.

    Attributes:
        name, value, allowed: as given.
    """

    def __init__(self, name: str, value: Any, allowed: str) -> None:
        super().__init__(f"parameter '{name}' is {_show(value)}; allowed: {allowed}")
        self.name = name
        self.value = value
        self.allowed = allowed


def _show(value: Any) -> str:
    if value is None:
        return "not set"
    if hasattr(value, "tolist"):  # an array; NumPy takes too long to import for entry points
        value = value.tolist()
    if isinstance(value, str):
        return repr(value)
    if isinstance(value, Sequence):
        return "[" + ", ".join(_show(item) for item in value) + "]"
    return f"{value:g}" if isinstance(value, float) else str(value)
