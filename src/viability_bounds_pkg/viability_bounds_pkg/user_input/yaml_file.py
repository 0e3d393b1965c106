# SPDX-License-Identifier: Apache-2.0
"""YAML that users write: errors in one line that names the place."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import yaml

from viability_bounds_pkg.exceptions import ArmSafetyError, did_you_mean


class YamlError(ArmSafetyError, ValueError):
    """A file that cannot be read, is no YAML, or has a key twice."""


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """Takes each key of a mapping once, and 1e-3 for a number, as rcl does."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        keys = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode) and key.value in keys:
                problem = f"'{key.value}' a second time"
                raise yaml.constructor.ConstructorError(None, None, problem, key.start_mark)
            keys.add(key.value)
        return super().construct_mapping(node, deep)


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?$"),
    list("-+.0123456789"),
)


def load_yaml(text: str, where: str = "") -> Any:
    """Return what a YAML text says.

    Args:
        text: one document.
        where: its file, for errors.

    Raises:
        YamlError: it is no YAML, or a key stands twice in a mapping.
    """
    try:
        return yaml.load(text, _Loader)
    except (yaml.YAMLError, ValueError) as error:
        mark = getattr(error, "problem_mark", None)
        place = where if mark is None else f"{where}, line {mark.line + 1}"
        problem = getattr(error, "problem", None) or " ".join(str(error).split())
        raise YamlError(f"{place}: {problem}".lstrip(",: ")) from error


def read_yaml(path: str | Path) -> Any:
    """Return what a YAML file says.

    Raises:
        YamlError: the file cannot be read, is no YAML, or has a key twice in a mapping.
    """
    try:
        text = Path(path).read_text(encoding="utf-8")
    except FileNotFoundError as error:
        hint = did_you_mean(Path(path).name, (each.name for each in Path(path).parent.glob("*")))
        raise YamlError(f"{path}: there is no such file{hint}") from error
    except (OSError, UnicodeDecodeError) as error:
        raise YamlError(f"{path}: {getattr(error, 'strerror', 'it is no text')}") from error
    return load_yaml(text, str(path))
