"""What one figure of a paper came to: picture, data, metrics, and rows of the table."""

from __future__ import annotations

import json
from dataclasses import dataclass, field

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from chain import ROOT

RESULTS = ROOT / "results"


@dataclass
class Figure:
    """What one figure of the paper came to.

    Attributes:
        name: folder under results/.
        data: arrays for ``data.npz``.
        metrics: numbers for ``metrics.json``.
        rows: (what, the paper, here, agreement or why not) for the table.
    """

    name: str
    data: dict[str, np.ndarray] = field(default_factory=dict)
    metrics: dict[str, float] = field(default_factory=dict)
    rows: list[tuple[str, str, str, str]] = field(default_factory=list)

    def save(self, picture: plt.Figure | None) -> None:
        """Write picture, data and metrics."""
        directory = RESULTS / self.name
        directory.mkdir(parents=True, exist_ok=True)
        if picture is not None:
            picture.savefig(directory / "figure.png", dpi=130)
            plt.close(picture)
        np.savez_compressed(directory / "data.npz", **self.data)
        (directory / "metrics.json").write_text(json.dumps(self.metrics, indent=2) + "\n")


def table(
    figures: list[Figure], heads: tuple[str, ...] = ("figure", "the paper", "here", "")
) -> str:
    """Return the rows of all figures as a Markdown table."""
    lines = ["| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
    for figure in figures:
        lines += ["| " + " | ".join(row) + " |" for row in figure.rows]
    return "\n".join(lines)
