# SPDX-License-Identifier: Apache-2.0
"""Names that the nodes of this project have; `scripts/make_reference.py` writes the lists."""

from __future__ import annotations

import re
from collections.abc import Iterable
from functools import cache
from importlib.resources import files

from viability_bounds_pkg.exceptions import did_you_mean


@cache
def parameter_names() -> frozenset[str]:
    """Return the names of the parameters of all nodes."""
    return frozenset(_text("parameter_names.txt").split())


_OF_ROS = re.compile(r"use_sim_time|start_type_description_service|qos_overrides\..*")
"""Parameters that rclpy declares by itself where it wants them."""


def unknown_parameters(given: Iterable[str], known: Iterable[str] = ()) -> str:
    """Return which names are no parameters, in words with the nearest known ones; empty if none.

    Args:
        given: the names.
        known: those that are parameters although no node of this project has them.
    """
    every = {*known, *parameter_names()}
    unknown = [name for name in given if name not in every and not _OF_ROS.fullmatch(name)]
    return "; ".join(f"unknown parameter '{name}'{_hint(name, every)}" for name in sorted(unknown))


def _hint(name: str, known: Iterable[str]) -> str:
    node, _, parameter = name.partition(".")
    if node in graph_names("node"):
        return f"; of one node alone it is written '{node}:{parameter}'"
    return did_you_mean(name, known)


@cache
def graph_names(kind: str) -> frozenset[str]:
    """Return the names of all nodes, topics or services, without a namespace.

    Args:
        kind: ``node``, ``topic`` or ``service``.
    """
    pairs = (line.split() for line in _text("graph_names.txt").splitlines())
    return frozenset(name for of, name in pairs if of == kind)


def _text(file: str) -> str:
    return files("viability_bounds_pkg").joinpath("ros", file).read_text("utf-8")
