# SPDX-License-Identifier: Apache-2.0
"""What the command line and parameter files say about the parameters of one node.

rcl reads them, too, but keeps 500 where 250.0 or a word is given later, lets the section of one
node in a file win over a later ``-p name:=value``, and reads null as the string "null". Here the
last value given counts, and null is none.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any
from weakref import WeakKeyDictionary

from viability_bounds_pkg.parameter_files import is_section_of, load_yaml, values_for

_ARGUMENTS: WeakKeyDictionary[Any, Sequence[str]] = WeakKeyDictionary()


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
