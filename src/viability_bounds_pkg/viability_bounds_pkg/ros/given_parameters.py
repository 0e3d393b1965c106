# SPDX-License-Identifier: Apache-2.0
"""What the command line and parameter files say about the parameters of one node.

rcl reads them, too, but keeps 500 where 250.0 is given later, lets the section of one node in a
file win over a later ``-p name:=value``, reads null as the string "null", and says nothing of
names that no node has. Here the last value given counts, null is none, and all names are told.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any
from weakref import WeakKeyDictionary

import yaml

from viability_bounds_pkg.exceptions import ArmSafetyError

_OF_ROS = re.compile(r"use_sim_time|start_type_description_service|qos_overrides\..*")
"""Parameters that rclpy declares by itself where it wants them."""


class UnknownParameterError(ArmSafetyError, ValueError):
    """A parameter was given that no node of this project has."""


class _Loader(yaml.SafeLoader):
    """Reads numbers as rcl does: 1e-3 is one."""


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?$"),
    list("-+.0123456789"),
)


def given_parameters(arguments: Sequence[str], node: str) -> dict[str, Any]:
    """Return the values given for a node, by parameter, the last one of each.

    Args:
        arguments: of the command line.
        node: its fully qualified name, such as ``/left/bounds_node``.
    """
    values: dict[str, Any] = {}
    for section, parameters in _sections(arguments):
        if is_section_of(section, node):
            values |= parameters
    return values


_ARGUMENTS: WeakKeyDictionary[Any, Sequence[str]] = WeakKeyDictionary()


def note_arguments(context: Any, arguments: Sequence[str]) -> None:
    """Remember the command line that an rclpy context was initialised with."""
    _ARGUMENTS[context] = arguments


def arguments_of(context: Any) -> Sequence[str]:
    """Return the command line of an rclpy context; nothing if none was noted."""
    return _ARGUMENTS.get(context, ())


def why_missing(arguments: Sequence[str], node: str) -> str:
    """Return why a node has no values, to follow an error: no file, or no section in it."""
    sections = _sections_of_files(arguments)
    if not sections:
        return "; no parameter file was given (--params-file)"
    if any(is_section_of(section, node) for section in sections if section != "/**"):
        return ""
    return f"; the parameter files have no section '/**{node}', only {', '.join(sections)}"


def refuse_renamed(arguments: Sequence[str], node: str, usual: str) -> None:
    """Raise `UnknownParameterError` if files speak of a node by its usual name only.

    Args:
        arguments: of the command line.
        node: fully qualified name of the node.
        usual: its name where it is not remapped.
    """
    namespace, _, name = node.rpartition("/")
    sections = [section for section in _sections_of_files(arguments) if section != "/**"]
    of_usual = [each for each in sections if is_section_of(each, f"{namespace}/{usual}")]
    if name != usual and of_usual and not any(is_section_of(each, node) for each in sections):
        raise UnknownParameterError(
            f"the parameter files have '{of_usual[0]}', but this node is '{node}': "
            f"name the section '/**/{name}'"
        )


def _sections_of_files(arguments: Sequence[str]) -> list[str]:
    """Return the names of the sections that parameter files have, each once."""
    files_only = [
        word
        for flag, value in _rules(arguments)
        if flag == "--params-file"
        for word in ("--ros-args", flag, value)
    ]
    return list(dict.fromkeys(section for section, _ in _sections(files_only)))


def refuse_unknown(given: Iterable[str], known: Iterable[str]) -> None:
    """Raise `UnknownParameterError` for names that neither the node nor another one has.

    Args:
        given: names of parameters for which there are values.
        known: names of those that the node has.
    """
    every = {*known, *_names_in_project()}
    unknown = [name for name in given if name not in every and not _OF_ROS.fullmatch(name)]
    if unknown:
        raise UnknownParameterError(
            "; ".join(unknown_parameter(name, every) for name in sorted(unknown))
        )


def unknown_parameter(name: str, known: Iterable[str]) -> str:
    """Return what to say of an unknown name, with the one of those known that is most alike."""
    alike = difflib.get_close_matches(name, sorted(known), n=1, cutoff=0.6)
    return f"unknown parameter '{name}'" + (f"; did you mean '{alike[0]}'?" if alike else "")


@cache
def _names_in_project() -> frozenset[str]:
    """Return the names of the parameters of all nodes; `scripts/make_reference.py` writes them."""
    text = files("viability_bounds_pkg.ros").joinpath("parameter_names.txt").read_text("utf-8")
    return frozenset(text.split())


def _rules(arguments: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Yield parameter rules and files in their order: flag and value."""
    ros, flag = False, ""
    for word in arguments:
        if flag:
            yield flag, word
            flag = ""
        elif word in ("--ros-args", "--"):
            ros = word == "--ros-args"
        elif ros and word in ("-p", "--param", "--params-file"):
            flag = "--params-file" if word == "--params-file" else "-p"


def _sections(arguments: Sequence[str]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield what is given: for which nodes, and values by parameter.

    What cannot be read is left out: rcl has refused it already, with a message of its own.
    """
    for flag, text in _rules(arguments):
        try:
            if flag == "-p":
                name, value = text.split(":=", 1)
                node, _, name = name.rpartition(":")
                section = f"/**/{node.strip('/')}" if node else "/**"
                yield section, _flat({name: yaml.load(value, _Loader)})
            else:
                content = yaml.load(Path(text).read_text(encoding="utf-8"), _Loader)
                yield from _nodes("", content)
        except (OSError, ValueError, yaml.YAMLError):
            continue


def _nodes(path: str, content: Any) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the sections below a namespace."""
    if not isinstance(content, Mapping):
        return
    for key, value in content.items():
        if key == "ros__parameters":
            yield path, _flat(value)
        else:
            yield from _nodes(f"{path}/{str(key).strip('/')}", value)


def _flat(values: Any, prefix: str = "") -> dict[str, Any]:
    """Return nested values by dotted name."""
    if not isinstance(values, Mapping):
        return {}
    flat: dict[str, Any] = {}
    for key, value in values.items():
        name = f"{prefix}{key}"
        flat |= _flat(value, f"{name}.") if isinstance(value, Mapping) else {name: value}
    return flat


def is_section_of(section: str, node: str) -> bool:
    """Return whether a section, with ``*`` for a name and ``**`` for any, is for a node."""
    words = (re.escape(word) for word in section.strip("/").split("/"))
    kinds = {re.escape("**"): "(/[^/]+)*", re.escape("*"): "/[^/]+"}
    return re.fullmatch("".join(kinds.get(word, f"/{word}") for word in words), node) is not None
