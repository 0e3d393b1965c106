# SPDX-License-Identifier: Apache-2.0
"""Parameter files: YAML as rcl takes it, and mistakes that rcl ignores, each told in one line.

rcl keeps 500 where 250.0 or a word is given later, lets the section of one node in a file win over
a later ``-p name:=value``, and reads null as the string "null". Here the last value given counts,
and null is none.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cache
from importlib.resources import files
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar
from weakref import WeakKeyDictionary

import yaml

from viability_bounds_pkg.exceptions import ArmSafetyError, SettingError, did_you_mean
from viability_bounds_pkg.parameter import read

Configuration = TypeVar("Configuration")

NODES = (
    "bounds_node",
    "estimator_node",
    "controller_node",
    "bullet_node",
    "franka_node",
    "simulated_fr3",
    "scenario_node",
    "viewer_node",
    "moveit_node",
)
"""Nodes of this project."""

_VALUES = "ros__parameters"
_ARGUMENTS: WeakKeyDictionary[Any, Sequence[str]] = WeakKeyDictionary()


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
            yield section, {str(name): each for name, each in value.items()}
        else:
            yield from _sections(value, path, f"{section}/{str(key).strip('/')}")


def is_section_of(section: str, node: str) -> bool:
    """Return whether a section, with ``*`` for a name and ``**`` for any, is for a node."""
    words = (re.escape(word) for word in section.strip("/").split("/"))
    kinds = {re.escape("**"): "(/[^/]+)*", re.escape("*"): "/[^/]+"}
    return re.fullmatch("".join(kinds.get(word, f"/{word}") for word in words), node) is not None


def values_for(path: str | Path, node: str) -> dict[str, Any]:
    """Return the values that the sections of a parameter file give a node, by its full name.

    Raises:
        YamlError, ParameterFileError: see `read_sections`.
    """
    values: dict[str, Any] = {}
    for section, parameters in read_sections(path).items():
        if is_section_of(section, node):
            values |= parameters
    return values


def node_parameters(paths: Sequence[Path], node: str) -> dict[str, Any]:
    """Return the parameters of one node, those for all nodes included.

    Args:
        paths: parameter files; of several values of a parameter the last one counts.
        node: its name, which may follow ``/**/``.

    Raises:
        YamlError, ParameterFileError: see `read_sections`; a misspelt parameter; none for `node`.
    """
    parameters: dict[str, Any] = {}
    for path in paths:
        values = values_for(path, f"/{node.rpartition('/')[2]}")
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
        YamlError, ParameterFileError: see `node_parameters`; or a value is missing, of another
            type, or not allowed.
    """
    try:
        return read(kind, node_parameters(paths, node))
    except SettingError as error:
        raise ParameterFileError(f"{_listed(paths)}: {error}") from error


def _listed(paths: Sequence[Path]) -> str:
    return ", ".join(map(str, paths))


@cache
def parameter_names() -> frozenset[str]:
    """Return the parameters of all nodes, as `scripts/make_reference.py` lists them."""
    text = files("viability_bounds_pkg").joinpath("ros", "parameter_names.txt").read_text("utf-8")
    return frozenset(text.split())


def unknown_parameters(given: Iterable[str], known: Iterable[str] = ()) -> str:
    """Return which names are no parameters, in words with the nearest known ones; empty if none.

    A file has parameters of several nodes in its section for all of them.

    Args:
        given: the names.
        known: those that are parameters although no node of this project has them.
    """
    every = {*known, *parameter_names()}
    unknown = sorted(set(given) - every)
    return "; ".join(f"unknown parameter '{each}'{did_you_mean(each, every)}" for each in unknown)


def remember_arguments(context: Any, arguments: Sequence[str]) -> None:
    """Remember the command line that an rclpy context was initialised with."""
    _ARGUMENTS[context] = arguments


def given_parameters(context: Any, node: str) -> dict[str, Any]:
    """Return the values given for a node, by parameter, the last one of each.

    Args:
        context: of rclpy.
        node: its fully qualified name, such as ``/left/bounds_node``.

    Raises:
        YamlError: a file cannot be read, or a value is no YAML.
        ParameterFileError: a file is no parameter file.
    """
    values: dict[str, Any] = {}
    for flag, text in pairwise(_ARGUMENTS.get(context, ())):
        if flag == "--params-file":
            values |= values_for(text, node)
        elif flag in ("-p", "--param"):
            name, _, value = text.partition(":=")
            of, _, name = name.rpartition(":")
            if not of or is_section_of(f"/**/{of}", node):
                values[name] = load_yaml(value)
    return values
