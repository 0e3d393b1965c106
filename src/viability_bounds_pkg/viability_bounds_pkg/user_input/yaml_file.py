# SPDX-License-Identifier: Apache-2.0
"""YAML that users write: read strictly, and refused in one line that names the place."""

from __future__ import annotations

import re
from contextlib import suppress
from pathlib import Path
from typing import Any

import yaml

from viability_bounds_pkg.exceptions import ArmSafetyError, did_you_mean


class YamlError(ArmSafetyError, ValueError):
    """A file that cannot be read, is no YAML, or has a key twice."""


class _Strict(yaml.constructor.SafeConstructor):
    """Takes each key of a mapping once."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        first: dict[str, int] = {}
        for key, _ in node.value:
            line = key.start_mark.line + 1
            if key.value in first and isinstance(key, yaml.ScalarNode):
                problem = f"'{key.value}' a second time; it is in line {first[key.value]} already"
                raise yaml.constructor.ConstructorError(None, None, problem, key.start_mark)
            if isinstance(key, yaml.ScalarNode):
                first[key.value] = line
        return super().construct_mapping(node, deep)


class _Loader(_Strict, yaml.SafeLoader):
    """Says best what is wrong."""


class _FastLoader(_Strict, getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """Several times as fast, where PyYAML was built with LibYAML."""


for _each in (_Loader, _FastLoader):
    _each.add_implicit_resolver(  # 1e-3 is a number, as for rcl
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
    with suppress(yaml.YAMLError, ValueError):
        return yaml.load(text, _FastLoader)
    try:
        return yaml.load(text, _Loader)
    except yaml.MarkedYAMLError as error:
        problem, mark = error.problem or error.context or "no YAML", error.problem_mark
        if r"'\t'" in problem:
            problem = "a tab; only spaces may indent"
        place = where if mark is None else f"{where}, line {mark.line + 1}".removeprefix(", ")
        raise YamlError(f"{place}: {problem}") from error
    except (yaml.YAMLError, ValueError) as error:
        raise YamlError(f"{where}: {' '.join(str(error).split())}".removeprefix(": ")) from error


def read_yaml(path: str | Path) -> Any:
    """Return what a YAML file says.

    Raises:
        YamlError: the file cannot be read, is no YAML, or has a key twice in a mapping.
    """
    try:
        text = Path(path).read_text(encoding="utf-8")
    except FileNotFoundError as error:
        folder = Path(path).parent
        names = [each.name for each in folder.iterdir()] if folder.is_dir() else []
        hint = did_you_mean(Path(path).name, names)
        raise YamlError(f"{path}: there is no such file{hint}") from error
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is no text"
        raise YamlError(f"{path}: {reason}") from error
    return load_yaml(text, str(path))
