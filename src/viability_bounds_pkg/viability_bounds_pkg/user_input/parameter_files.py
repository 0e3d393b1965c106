# SPDX-License-Identifier: Apache-2.0
"""Parameter files: their sections, and the mistakes in them that rcl ignores or does not name."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from viability_bounds_pkg.exceptions import ArmSafetyError, SettingError, did_you_mean
from viability_bounds_pkg.parameter import read
from viability_bounds_pkg.user_input.known_names import graph_names, unknown_parameters
from viability_bounds_pkg.user_input.yaml_file import read_yaml

Configuration = TypeVar("Configuration")

_VALUES = "ros__parameters"


class ParameterFileError(ArmSafetyError, ValueError):
    """A parameter file that is none, lacks what is needed, or says what no node reads."""


def sections_of(content: Any, path: str = "") -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the sections of a parameter file, below a namespace: name, and values by parameter."""
    if not isinstance(content, Mapping):
        return
    for key, value in content.items():
        if key == _VALUES:
            yield path, flat(value)
        else:
            yield from sections_of(value, f"{path}/{str(key).strip('/')}")


def flat(values: Any, prefix: str = "") -> dict[str, Any]:
    """Return nested values by dotted name."""
    if not isinstance(values, Mapping):
        return {}
    result: dict[str, Any] = {}
    for key, value in values.items():
        name = f"{prefix}{key}"
        result |= flat(value, f"{name}.") if isinstance(value, Mapping) else {name: value}
    return result


def check_parameter_files(paths: Sequence[str]) -> None:
    """Check parameter files, in the order in which they are given.

    Raises:
        YamlError: a file cannot be read, is no YAML, or has a key twice.
        ParameterFileError: a file is no parameter file, has a section whose name is misspelt, or
            is for another robot than one before it.
    """
    robots: dict[str, str] = {}
    for path in paths:
        content = read_yaml(path)
        if not isinstance(content, Mapping) or not content:
            raise ParameterFileError(f"{path}: there are no parameters in it")
        _check_shape(content, path, "")
        for section, values in sections_of(content):
            _check_section(section, path)
            for name, value in values.items():
                check_value(value, f"{path}: parameter '{name}'")
            if "robot_name" in values:
                robots[str(values["robot_name"])] = path
    if len(robots) > 1:
        places = " and ".join(f"'{name}' in {path}" for name, path in robots.items())
        raise ParameterFileError(f"the parameter files are for several robots: {places}")


def _check_shape(content: Mapping[Any, Any], path: str, section: str) -> None:
    """Refuse values outside 'ros__parameters', and a section without any."""
    for key, value in content.items():
        if key == _VALUES:
            if not isinstance(value, Mapping):
                raise ParameterFileError(f"{path}: '{section}' has no parameters")
            continue
        hint = did_you_mean(str(key), [_VALUES], alike=0.85)
        if isinstance(value, Mapping) and value and not hint:
            _check_shape(value, path, f"{section}/{str(key).strip('/')}")
            continue
        place = f"'{key}' of '{section}'" if section else f"'{key}'"
        form = "; a file reads /**: {ros__parameters: {NAME: VALUE}}"
        raise ParameterFileError(f"{path}: {place} is not below '{_VALUES}'{hint or form}")


def _check_section(section: str, path: str) -> None:
    """Refuse a section whose name is that of a node but for a letter or two."""
    name = section.rpartition("/")[2]
    nodes = graph_names("node")
    if "*" in name or any(node in name for node in nodes):
        return
    if hint := did_you_mean(name, nodes, alike=0.85):
        raise ParameterFileError(f"{path}: section '{section}' is for no node{hint}")


def check_value(value: Any, what: str) -> None:
    """Raise `ParameterFileError`, naming `what`, for a value that rcl reads otherwise, or not."""
    for item in value if isinstance(value, list) else [value]:
        if isinstance(item, int) and not -(2**63) <= item < 2**63:
            raise ParameterFileError(f"{what} is {_short(value)}; allowed: numbers of 64 bits")
        if item is not value and item is None or not isinstance(item, _SCALARS):
            raise ParameterFileError(
                f"{what} is {_short(value)}; allowed: numbers, strings in quotes, true and false, "
                "or a list of them"
            )
    if isinstance(value, list) and len({type(item) for item in value}) > 1:
        only_numbers = {type(item) for item in value} == {int, float}
        allowed = "all with a decimal point, or none" if only_numbers else "items of one type"
        raise ParameterFileError(f"{what} is {value}; allowed: {allowed}")


_SCALARS = bool | int | float | str | None


def _short(value: Any) -> str:
    text = str(value)
    return text if len(text) < 80 else f"{text[:76]} ..."


def node_parameters(paths: Sequence[Path], node: str) -> dict[str, Any]:
    """Return the parameters of one node, those for all nodes included.

    Args:
        paths: parameter files; of several values of a parameter the last one counts.
        node: ``/**/name``; sections ``name`` and ``/name`` count as well.

    Raises:
        YamlError: a file cannot be read, is no YAML, or has a key twice.
        ParameterFileError: a file is no parameter file, or has a misspelt parameter; there is
            none for `node`; the files are for several robots.
    """
    check_parameter_files([str(path) for path in paths])
    name = node.rpartition("/")[2]
    parameters: dict[str, Any] = {}
    for path in paths:
        given: dict[str, Any] = {}
        for section, values in sections_of(read_yaml(path)):
            if section in ("/**", f"/{name}", node):
                given.update(values)
        if unknown := unknown_parameters(given):
            raise ParameterFileError(f"{path}: {unknown}")
        parameters |= given
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
