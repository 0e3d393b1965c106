# SPDX-License-Identifier: Apache-2.0
"""Draws the rooms of the packages, and which of them imports which: docs/images/rooms.png.

A room is a folder, or the modules at the top of a package. Its height is its number of lines.
"""

from __future__ import annotations

import argparse
import ast
from collections import Counter, defaultdict
from pathlib import Path

import matplotlib.pyplot as plt
from matplotlib.patches import FancyArrowPatch, Rectangle

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = {
    "sim_bridge": "tab:green",
    "franka_bridge": "tab:red",
    "viability_bounds_pkg": "tab:blue",
    "torque_safety_controller": "tab:orange",
}
LINES_PER_UNIT = 260.0
GAP, WIDTH, APART = 0.9, 5.2, 10.5
NOT_DRAWN = {"testing", "test"}


def rooms(tree: Path) -> tuple[Counter[str], Counter[tuple[str, str]]]:
    """Return the lines of each room, and how often modules of one import those of another."""
    lines: Counter[str] = Counter()
    arrows: Counter[tuple[str, str]] = Counter()
    for package in PACKAGES:
        top = tree / "src" / package / package
        for path in sorted(top.rglob("*.py")):
            parts = path.relative_to(top.parent).with_suffix("").parts
            if NOT_DRAWN & set(parts):
                continue
            text = path.read_text()
            lines[room := ".".join(parts[:2] if len(parts) > 2 else parts[:1])] += text.count("\n")
            for node in ast.walk(ast.parse(text)):
                if isinstance(node, ast.ImportFrom) and node.module:
                    other = node.module.split(".")
                    if other[0] in PACKAGES and not NOT_DRAWN & set(other):
                        folder = (top.parent.parent / other[0]).joinpath(*other[:2]).is_dir()
                        arrows[room, ".".join(other[: 2 if folder and len(other) > 1 else 1])] += 1
    return lines, arrows


def depth_of(room: str, below: dict[str, set[str]], on_way: tuple[str, ...] = ()) -> int:
    """Return how many rooms of the same package a room stands on, one upon the other."""
    others = (each for each in below[room] if each not in (*on_way, room))
    return max((1 + depth_of(each, below, (*on_way, room)) for each in others), default=0)


def draw(tree: Path, picture: Path) -> None:
    """Draw the rooms of a checkout, those that others stand on at the bottom."""
    lines, arrows = rooms(tree)
    below: dict[str, set[str]] = defaultdict(set)
    for one, other in arrows:
        if one.split(".")[0] == other.split(".")[0]:
            below[one].add(other)
    places: dict[str, tuple[float, float, float]] = {}
    figure, axes = plt.subplots(figsize=(15.0, 10.0))
    for column, (package, colour) in enumerate(PACKAGES.items()):
        own = [room for room in lines if room.split(".")[0] == package]
        y, x = 0.0, column * APART
        for room in sorted(own, key=lambda each: (depth_of(each, below), each)):
            height = max(lines[room] / LINES_PER_UNIT, 1.0)
            places[room] = x, y, height
            axes.add_patch(Rectangle((x, y), WIDTH, height, fc=colour, alpha=0.25, ec=colour))
            name = room.partition(".")[2] or "(top)"
            axes.text(
                x + WIDTH / 2, y + height / 2, f"{name}  {lines[room]}", ha="center", va="center"
            )
            y += height + GAP
        total = sum(lines[room] for room in own)
        axes.text(x + WIDTH / 2, y + 0.6, f"{package}: {total} lines", ha="center", weight="bold")
    for (one, other), count in arrows.items():
        if one == other or other not in places:
            continue
        (x, y, height), (x2, y2, height2) = places[one], places[other]
        same = x == x2
        start = x + (WIDTH if same or x2 > x else 0.0), y + height / 2
        end = x2 + (WIDTH if same or x2 < x else 0.0), y2 + height2 / 2
        bend = (-0.45 if y > y2 else 0.45) if same else 0.0
        axes.add_patch(
            FancyArrowPatch(
                start,
                end,
                connectionstyle=f"arc3,rad={bend}",
                arrowstyle="->",
                mutation_scale=9,
                lw=0.4 + 0.12 * min(count, 15),
                alpha=0.45,
                color=PACKAGES[one.split(".")[0]],
            )
        )
    axes.set_xlim(-1.0, 2 * APART + WIDTH + 3.5)
    axes.set_ylim(-1.0, max(y + h for _, y, h in places.values()) + 2.5)
    axes.axis("off")
    figure.tight_layout()
    figure.savefig(picture, dpi=90)


def main() -> None:
    """Draw the rooms of this checkout, or of another one."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--tree", type=Path, default=ROOT, help="checkout to draw")
    parser.add_argument("--picture", type=Path, default=ROOT / "docs" / "images" / "rooms.png")
    options = parser.parse_args()
    draw(options.tree, options.picture)


if __name__ == "__main__":
    main()
