# SPDX-License-Identifier: Apache-2.0
"""What the command line and parameter files say about the parameters of one node.

rcl reads them, too, but keeps 500 where 250.0 is given later, lets the section of one node in a
file win over a later ``-p name:=value``, reads null as the string "null", and says nothing of
names that no node has. Here the last value given counts, null is none, and all names are told.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from typing import Any
from weakref import WeakKeyDictionary

from viability_bounds_pkg.exceptions import ArmSafetyError
from viability_bounds_pkg.ros.ros_arguments import ros_rules
from viability_bounds_pkg.user_input.parameter_files import flat, sections_of
from viability_bounds_pkg.user_input.yaml_file import load_yaml, read_yaml


class UnknownParameterError(ArmSafetyError, ValueError):
    """A parameter was given that no node of this project has."""


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


def foreign_sections(arguments: Sequence[str], node: str) -> list[str]:
    """Return sections for a node of this name elsewhere, in files that have none for this one.

    Args:
        arguments: of the command line.
        node: its fully qualified name.
    """
    foreign: list[str] = []
    name = node.rpartition("/")[2]
    for flag, path in ros_rules(arguments):
        sections = _sections_of_files(["--ros-args", flag, path])
        named = [each for each in sections if each.rpartition("/")[2] == name]
        if not any(is_section_of(each, node) for each in named):
            foreign += named
    return foreign


def _sections_of_files(arguments: Sequence[str]) -> list[str]:
    """Return the names of the sections that parameter files have, each once."""
    files_only = [
        word
        for flag, value in ros_rules(arguments)
        if flag == "--params-file"
        for word in ("--ros-args", flag, value)
    ]
    return list(dict.fromkeys(section for section, _ in _sections(files_only)))


def _sections(arguments: Sequence[str]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield what is given: for which nodes, and values by parameter.

    What cannot be read is left out: rcl has refused it already, with a message of its own.
    """
    for flag, text in ros_rules(arguments):
        try:
            if flag == "--params-file":
                yield from sections_of(read_yaml(text))
            elif flag == "-p":
                name, value = text.split(":=", 1)
                node, _, name = name.rpartition(":")
                section = f"/**/{node.strip('/')}" if node else "/**"
                yield section, flat({name: load_yaml(value)})
        except ValueError:
            continue


def is_section_of(section: str, node: str) -> bool:
    """Return whether a section, with ``*`` for a name and ``**`` for any, is for a node."""
    words = (re.escape(word) for word in section.strip("/").split("/"))
    kinds = {re.escape("**"): "(/[^/]+)*", re.escape("*"): "/[^/]+"}
    return re.fullmatch("".join(kinds.get(word, f"/{word}") for word in words), node) is not None
