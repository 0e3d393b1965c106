# SPDX-License-Identifier: Apache-2.0
"""List entries that are YAML mappings, as "{name: wall, shape: box, size: [0.1, 1.0, 1.0]}"."""

from __future__ import annotations

from functools import lru_cache
from typing import TypeVar

from viability_bounds_pkg.exceptions import SettingError, did_you_mean
from viability_bounds_pkg.parameter import parameter_table, read
from viability_bounds_pkg.parameter_files import YamlError, load_yaml

Entry = TypeVar("Entry")


@lru_cache(maxsize=16)  # other parameters change while a control loop waits
def read_entries(kind: type[Entry], parameter: str, entries: tuple[str, ...]) -> tuple[Entry, ...]:
    """Return what the entries of a parameter say.

    Args:
        kind: dataclass whose fields are declared as parameters.
        parameter: name of the list of strings.
        entries: YAML mappings in flow style.

    Raises:
        SettingError: an entry is no mapping, has another field, or a value is not allowed.
    """
    return tuple(_read(kind, f"{parameter}[{i}]", text) for i, text in enumerate(entries))


def _read(kind: type[Entry], label: str, text: str) -> Entry:
    fields = [row.name for row in parameter_table(kind)]
    reason = ""
    try:
        values = load_yaml(text)
    except YamlError as error:
        values, reason = None, f" ({error})"
    if not isinstance(values, dict) or not set(values) <= set(fields):
        for name in values if isinstance(values, dict) else ():
            reason = reason or ("" if name in fields else did_you_mean(str(name), fields))
        allowed = f"a YAML mapping with the fields {', '.join(fields)}{reason}"
        raise SettingError(label, text, allowed)
    try:
        return read(kind, values)
    except SettingError as error:
        raise SettingError(f"{label}.{error.name}", error.value, error.allowed) from error
