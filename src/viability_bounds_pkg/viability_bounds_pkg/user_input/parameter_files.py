# SPDX-License-Identifier: Apache-2.0
"""Parameter files, as tools read them without ROS, and mistakes in them that rcl ignores."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from viability_bounds_pkg.exceptions import ArmSafetyError, SettingError, did_you_mean
from viability_bounds_pkg.parameter import read
from viability_bounds_pkg.user_input.known_names import NODES, unknown_parameters
from viability_bounds_pkg.user_input.yaml_file import read_yaml

Configuration = TypeVar("Configuration")

_VALUES = "ros__parameters"


class ParameterFileError(ArmSafetyError, ValueError):
    """A parameter file that is none, lacks what is needed, or says what no node reads."""


def read_sections(path: str | Path) -> dict[str, Mapping[str, Any]]:
    """Return the sections of a parameter file: values by parameter, by name of the section.

    Raises:
        YamlError: the file cannot be read, is no YAML, or has a key twice.
        ParameterFileError: it is no parameter file, or a section has the name of a node but for
            a letter or two.
    """
    sections = dict(_sections(read_yaml(path), str(path)))
    if not sections:
        raise ParameterFileError(f"{path}: there are no parameters in it")
    for section in sections:
        name = section.rpartition("/")[2]
        hint = did_you_mean(name, NODES, alike=0.85)
        if hint and not any(node in name for node in NODES):
            raise ParameterFileError(f"{path}: section '{section}' is for no node{hint}")
    return sections


def _sections(content: Any, path: str, section: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in content.items() if isinstance(content, Mapping) else ():
        if not isinstance(value, Mapping):
            form = f"a file reads /**: {{{_VALUES}: {{NAME: VALUE}}}}"
            place = f"'{key}' of '{section}'" if section else f"'{key}'"
            raise ParameterFileError(f"{path}: {place} is not below '{_VALUES}'; {form}")
        if key == _VALUES:
            yield section, value
        else:
            yield from _sections(value, path, f"{section}/{str(key).strip('/')}")


def is_section_of(section: str, node: str) -> bool:
    """Return whether a section, with ``*`` for a name and ``**`` for any, is for a node."""
    words = (re.escape(word) for word in section.strip("/").split("/"))
    kinds = {re.escape("**"): "(/[^/]+)*", re.escape("*"): "/[^/]+"}
    return re.fullmatch("".join(kinds.get(word, f"/{word}") for word in words), node) is not None


def node_parameters(paths: Sequence[Path], node: str) -> dict[str, Any]:
    """Return the parameters of one node, those for all nodes included.

    Args:
        paths: parameter files; of several values of a parameter the last one counts.
        node: its name, which may follow ``/**/``.

    Raises:
        YamlError: see `read_sections`.
        ParameterFileError: see `read_sections`; a misspelt parameter; none for `node`.
    """
    parameters: dict[str, Any] = {}
    for path in paths:
        for section, values in read_sections(path).items():
            if not is_section_of(section, f"/{node.rpartition('/')[2]}"):
                continue
            if unknown := unknown_parameters(values):
                raise ParameterFileError(f"{path}: {unknown}")
            parameters |= values
    if not parameters:
        raise ParameterFileError(f"{_listed(paths)}: no parameters under '/**' or '{node}'")
    return parameters


def read_files(kind: type[Configuration], paths: Sequence[Path], node: str) -> Configuration:
    """Return the configuration that parameter files give a node.

    Args:
        kind: dataclass of the node's parameters.
        paths: see `node_parameters`.
        node: see `node_parameters`.

    Raises:
        YamlError: see `node_parameters`.
        ParameterFileError: see `node_parameters`; or a value is missing, of another type, or not
            allowed.
    """
    try:
        return read(kind, node_parameters(paths, node))
    except SettingError as error:
        raise ParameterFileError(f"{_listed(paths)}: {error}") from error


def _listed(paths: Sequence[Path]) -> str:
    return ", ".join(map(str, paths))
