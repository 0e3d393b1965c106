# SPDX-License-Identifier: Apache-2.0
"""Names that the nodes of this project have."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from importlib.resources import files

from viability_bounds_pkg.exceptions import did_you_mean

NODES = (
    "bounds_node",
    "estimator_node",
    "controller_node",
    "bullet_node",
    "scenario_node",
    "viewer_node",
    "moveit_node",
)


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
