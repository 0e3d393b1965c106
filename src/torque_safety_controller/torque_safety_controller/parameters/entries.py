# SPDX-License-Identifier: Apache-2.0
"""List entries that are YAML mappings, as "{name: wall, shape: box, size: [0.1, 1.0, 1.0]}"."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import TypeVar

import yaml

from viability_bounds_pkg.exceptions import SettingError
from viability_bounds_pkg.parameter import parameter_table, read

Entry = TypeVar("Entry")


class _Loader(yaml.SafeLoader):
    """Takes 1e-3 for a number, which YAML 1.1 takes for a string."""


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"[-+]?[0-9.]+[eE][-+]?[0-9]+$"), list("-+.0123456789")
)


def read_entries(kind: type[Entry], parameter: str, entries: Sequence[str]) -> tuple[Entry, ...]:
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
    try:
        values = yaml.load(text, _Loader)
    except (yaml.YAMLError, ValueError):
        values = None
    if not isinstance(values, dict) or not set(values) <= set(fields):
        raise SettingError(label, text, f"a YAML mapping with the fields {', '.join(fields)}")
    try:
        return read(kind, values)
    except SettingError as error:
        raise SettingError(f"{label}.{error.name}", error.value, error.allowed) from error
