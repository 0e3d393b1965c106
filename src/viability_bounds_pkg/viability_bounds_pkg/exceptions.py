# SPDX-License-Identifier: Apache-2.0
"""The errors that this project raises on purpose."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Sequence
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


def did_you_mean(name: str, known: Iterable[str], alike: float = 0.6) -> str:
    """Return "; did you mean ...?" with the known name that is most like `name`; empty if none is.

    Args:
        name: which is not known.
        known: what it may be; case and slashes at the ends do not count.
        alike: from 0, anything, to 1, the same.
    """
    plain = {each.strip("/").lower(): each for each in sorted(known, reverse=True)}
    found = difflib.get_close_matches(name.strip("/").lower(), plain, n=1, cutoff=alike)
    return f"; did you mean '{plain[found[0]]}'?" if found else ""


def _show(value: Any) -> str:
    if value is None:
        return "not set"
    if isinstance(value, bool):
        return str(value).lower()
    if hasattr(value, "tolist"):  # an array; NumPy takes too long to import for entry points
        value = value.tolist()
    if isinstance(value, str):
        return repr(value)
    if isinstance(value, Sequence):
        return "[" + ", ".join(_show(item) for item in value) + "]"
    return f"{value:g}" if isinstance(value, float) else str(value)
