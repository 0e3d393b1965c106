# SPDX-License-Identifier: Apache-2.0
"""Results for one figure of a paper: picture, data, metrics, and rows of the table."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from chain import ROOT

RESULTS = ROOT / "results"


@dataclass
class Figure:
    """Results for one figure of the paper.

    Attributes:
        name: folder under results/.
        data: arrays for ``data.npz``.
        metrics: numbers for ``metrics.json``.
        rows: (what, the paper, here, agreement or why not) for the table.
    """

    name: str
    data: dict[str, np.ndarray] = field(default_factory=dict)
    metrics: dict[str, float] = field(default_factory=dict)
    rows: list[tuple[str, ...]] = field(default_factory=list)

    def save(self, picture: plt.Figure | None) -> None:
        """Write picture, data and metrics."""
        directory = RESULTS / self.name
        directory.mkdir(parents=True, exist_ok=True)
        if picture is not None:
            picture.savefig(directory / "figure.png", dpi=130)
            plt.close(picture)
        np.savez_compressed(directory / "data.npz", **self.data)
        (directory / "metrics.json").write_text(json.dumps(self.metrics, indent=2) + "\n")


def joint_axes(joints: Sequence[str], x: str, y: str) -> tuple[plt.Figure, np.ndarray]:
    """Return a picture with axes for each of 7 joints, labelled `x` and `y`."""
    picture, axes = plt.subplots(2, 4, figsize=(14, 6), sharex=True, layout="constrained")
    axes[1, 3].set_visible(False)
    for axis, joint in zip(axes.flat, joints, strict=False):
        axis.set_title(joint)
        axis.grid(alpha=0.3)
    for axis in axes[:, 0]:
        axis.set_ylabel(y)
    for axis in axes[1, :3]:
        axis.set_xlabel(x)
    return picture, axes.flat[: len(joints)]


def table(
    figures: list[Figure], heads: tuple[str, ...] = ("figure", "the paper", "here", "")
) -> str:
    """Return the rows of all figures as a Markdown table."""
    lines = ["| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
    for figure in figures:
        lines += ["| " + " | ".join(row) + " |" for row in figure.rows]
    return "\n".join(lines)


def read_part(name: str, page: str = "results.md") -> str:
    """Return what a page of docs/ has between ``<!-- name -->`` and ``<!-- /name -->``."""
    return _split(name, page)[1]


def write_part(name: str, text: str, page: str = "results.md") -> None:
    """Write the part of a page of docs/ between ``<!-- name -->`` and ``<!-- /name -->``."""
    before, _, after = _split(name, page)
    (ROOT / "docs" / page).write_text(f"{before}\n\n{text.strip()}\n\n{after}")


def _split(name: str, page: str) -> tuple[str, str, str]:
    """Return a page up to the first mark, between the marks, and from the second mark on."""
    first, last = f"<!-- {name} -->", f"<!-- /{name} -->"
    text = (ROOT / "docs" / page).read_text()
    before, found, rest = text.partition(first)
    between, end, after = rest.partition(last)
    if not (found and end):
        raise ValueError(f"docs/{page} has no part between {first} and {last}")
    return before + first, between, last + after


def verdict(agrees: bool, text: str = "agrees") -> str:
    """Return the last entry of a row: `text`, or that it differs."""
    return text if agrees else "DIFFERS"


def reproduce(
    description: str,
    parts: Mapping[str, Callable[[], Figure]],
    write: Callable[[list[Figure]], None],
    show: Callable[[list[Figure]], str] = table,
) -> int:
    """Reproduce what the command line names, print the table, and tell whether all agrees.

    Args:
        description: of the command, its first line.
        parts: by name.
        write: makes a page of all figures; called when all were made.
        show: makes the table.

    Returns:
        1 when a row says that it differs from the paper, else 0.
    """
    parser = argparse.ArgumentParser(description=description.splitlines()[0])
    parser.add_argument("part", nargs="?", default="all", choices=("all", *parts))
    part = parser.parse_args().part
    figures = [make() for make in (parts.values() if part == "all" else [parts[part]])]
    print(show(figures))
    if part == "all":
        write(figures)
    return int(any("DIFFERS" in row[-1] for figure in figures for row in figure.rows))
