# SPDX-License-Identifier: Apache-2.0
"""What a command shows: picture, data, metrics, and rows of a table between marks of a page."""

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
from PIL import Image

RESULTS = ROOT / "results"
DOCS = ROOT / "docs"
WIDTH, COLORS = 1100, 200
"""Pixels and colours of pictures in docs/images, so that they stay small."""
HEADS = ("figure", "the paper", "here", "")
DIFFERS = "DIFFERS"

Row = tuple[str, ...]


@dataclass
class Figure:
    """What one figure shows.

    Attributes:
        name: folder under results/.
        part: of a page, where its rows go; empty for rows that are only printed.
        heads: of its table.
        page: under docs/.
        data: arrays for ``data.npz``.
        metrics: numbers for ``metrics.json``.
        rows: of the table; the last cell tells whether it is as claimed.
    """

    name: str
    part: str = ""
    heads: Row = HEADS
    page: str = "results.md"
    data: dict[str, np.ndarray] = field(default_factory=dict)
    metrics: dict[str, float] = field(default_factory=dict)
    rows: list[Row] = field(default_factory=list)

    def add(self, *cells: str, holds: bool = True, so: str = "agrees") -> None:
        """Add a row, whose last cell is `so` where what is claimed holds."""
        self.rows.append((*cells, so if holds else DIFFERS))

    def save(self, picture: plt.Figure | None = None, image: str = "") -> None:
        """Write picture, data and metrics, and the picture to docs/images under a name."""
        directory = RESULTS / self.name
        directory.mkdir(parents=True, exist_ok=True)
        if picture is not None:
            picture.savefig(directory / "figure.png", dpi=130)
            plt.close(picture)
        if image:
            large = Image.open(directory / "figure.png").convert("RGB")
            small = large.resize((WIDTH, round(large.height * WIDTH / large.width)))
            small = small.quantize(COLORS, Image.Quantize.MAXCOVERAGE)
            small.save(DOCS / "images" / f"{image}.png", optimize=True)
        np.savez_compressed(directory / "data.npz", **self.data)
        (directory / "metrics.json").write_text(json.dumps(self.metrics, indent=2) + "\n")


def table(rows: Sequence[Row], heads: Row = HEADS) -> str:
    """Return rows as a Markdown table."""
    lines = [f"| {' | '.join(cells)} |" for cells in (heads, *rows)]
    return "\n".join([lines[0], "|" + "---|" * len(heads), *lines[1:]])


def tables(figures: Sequence[Figure]) -> dict[tuple[str, str], str]:
    """Return the tables by page and part: figures with the same heads share one."""
    rows: dict[tuple[str, str], dict[Row, list[Row]]] = {}
    for figure in figures:
        if figure.rows:
            parts = rows.setdefault((figure.page, figure.part), {})
            parts.setdefault(figure.heads, []).extend(figure.rows)
    return {
        place: "\n\n".join(table(each, heads) for heads, each in parts.items())
        for place, parts in rows.items()
    }


def page_rows(part: str, page: str = "results.md") -> dict[tuple[str, str], Row]:
    """Return the rows of a part of a page, by the heading above them and their first cell."""
    heading, rows = "", {}
    lines = _split(part, page)[1].splitlines()
    for line, following in zip(lines, [*lines[1:], ""], strict=True):
        if line.startswith("### "):
            heading = line.removeprefix("### ")
        elif line.startswith("| ") and not following.startswith("|---"):
            cells = tuple(cell.strip() for cell in line[1:-1].split("|"))
            rows[heading, cells[0]] = cells
    return rows


def write_part(part: str, text: str, page: str = "results.md") -> None:
    """Write what a page of docs/ has between ``<!-- part -->`` and ``<!-- /part -->``."""
    before, _, after = _split(part, page)
    (DOCS / page).write_text(f"{before}\n\n{text.strip()}\n\n{after}")


def _split(part: str, page: str) -> tuple[str, str, str]:
    """Return a page up to the first mark, between the marks, and from the second mark on."""
    first, last = f"<!-- {part} -->", f"<!-- /{part} -->"
    before, found, rest = (DOCS / page).read_text().partition(first)
    between, end, after = rest.partition(last)
    if not (found and end):
        raise ValueError(f"docs/{page} has no part between {first} and {last}")
    return before + first, between, last + after


def reproduce(description: str, parts: Mapping[str, Callable[[], Figure]]) -> int:
    """Make the figures that the command line names, print their rows, and write whole tables.

    Args:
        description: of the command; its first line is shown.
        parts: by name.

    Returns:
        1 when something is not as claimed, else 0.
    """
    parser = argparse.ArgumentParser(description=description.splitlines()[0])
    parser.add_argument("part", nargs="?", default="all", choices=("all", *parts))
    wanted = parser.parse_args().part
    figures = [make() for name, make in parts.items() if wanted in ("all", name)]
    for (page, part), text in tables(figures).items():
        print(text, end="\n\n")
        if wanted == "all" and part:
            write_part(part, text, page)
    return int(any(DIFFERS in row[-1] for figure in figures for row in figure.rows))
