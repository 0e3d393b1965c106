# SPDX-License-Identifier: Apache-2.0
"""What imperfect robots did, kept from run to run, and the page and picture made of it."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from chain import ROOT
from figure import RESULTS, Figure, read_part, table, write_part

NAME = "imperfect"
WITHIN_DECLARED = ("all", "outage_stop", "filter", "filter_weak")
"""Cases in which no limit may be passed: what is spoilt is within what is declared."""
STEP_AT_REST = 0.05  # of torque_max
HAND_FACTOR = 3.0
TORQUE_ROUNDING = 1e-9  # share of torque_max
HEADS = (
    "what is spoilt, and what is done",
    "minutes",
    "position, rad",
    "speed, rad/s",
    "torque, of tau_max",
    "torque step, of tau_max",
    "at rest",
    "hand at rest, mm",
    "",
)
COST_HEADS = (
    "robot, nothing spoilt",
    "to upper limits, s",
    "back, s",
    "to lower limits, s",
    "back, s",
    "distance left at limits, mrad",
)
COSTS = "What the remedies cost an ideal robot"


@dataclass(frozen=True)
class Minute:
    """What a minute showed; the largest of all joints.

    Attributes:
        position, speed: how far beyond the limits, rad and rad/s.
        torque: share of torque_max.
        step: largest change of torque in a period, share of torque_max.
        step_at_rest: the same, at rest.
        stopped: periods in which the robot stopped by itself.
    """

    position: float
    speed: float
    torque: float
    step: float
    step_at_rest: float
    stopped: int


@dataclass(frozen=True)
class Outcome:
    """What the minutes of a case showed.

    Attributes:
        title: of the case.
        minutes: one by one.
        hands: distances of the hand at rest from goals, m.
        near: what counts as no error of the hand, m: a step of all encoders.
    """

    title: str
    minutes: list[Minute]
    hands: list[float]
    near: float

    def worst(self, name: str) -> float:
        """Return the largest value of all minutes."""
        return float(np.nanmax([getattr(minute, name) for minute in self.minutes]))

    @property
    def kept(self) -> bool:
        """Whether no limit was passed."""
        within = self.worst("position") <= 0.0 and self.worst("speed") <= 0.0
        return within and self.worst("torque") <= 1.0 + TORQUE_ROUNDING


Outcomes = dict[str, Outcome]
"""By name of the case."""

Row = tuple[str, ...]
"""Cells of a table, as `HEADS` and `COST_HEADS` have them."""


def verdict(name: str, outcome: Outcome, ideal_hand: float | None) -> str:
    """Return the last entry of a row, empty where nothing is promised.

    Args:
        name: of the case.
        outcome: of the case.
        ideal_hand: median distance of the hand with nothing spoilt, m, if it is known.
    """
    if name not in WITHIN_DECLARED:
        return ""
    wrong = [] if outcome.kept else ["a limit was passed"]
    if name == "all":
        if outcome.worst("step_at_rest") > STEP_AT_REST:
            wrong.append("step at rest")
        near = np.inf if ideal_hand is None else max(HAND_FACTOR * ideal_hand, outcome.near)
        if np.median(outcome.hands) > near:
            wrong.append("hand at rest")
    return f"DIFFERS: {', '.join(wrong)}" if wrong else "kept"


def row(name: str, outcome: Outcome, ideal_hand: float | None) -> Row:
    """Return a row of the table: the worst of the minutes, and the `verdict`."""
    hands = 1e3 * np.array(outcome.hands)
    return (
        outcome.title,
        str(len(outcome.minutes)),
        f"{outcome.worst('position'):.2g}",
        f"{outcome.worst('speed'):.2g}",
        f"{outcome.worst('torque'):.3f}",
        f"{outcome.worst('step'):.2f}",
        f"{outcome.worst('step_at_rest'):.3f}",
        f"{np.median(hands):.2f} to {hands.max():.2f}",
        verdict(name, outcome, ideal_hand),
    )


# Rows are kept in a file for each robot: robots can be played one after the other.


def kept_path(robot: str) -> Path:
    """Return where the rows of a robot are kept."""
    return RESULTS / NAME / f"{robot}.json"


def kept(robot: str) -> dict[str, Any]:
    """Return what is kept of a robot: "cases" and "costs", by name of the case."""
    path = kept_path(robot)
    return json.loads(path.read_text()) if path.exists() else {"cases": {}, "costs": {}}


def keep(robot: str, part: str, name: str, value: Any) -> None:
    """Keep what a case showed in place of what it showed before."""
    content = kept(robot)
    content[part][name] = value
    path = kept_path(robot)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, indent=1) + "\n")


def keep_outcome(robot: str, name: str, outcome: Outcome) -> None:
    """Keep the outcome of a case."""
    keep(robot, "cases", name, asdict(outcome))


def kept_outcomes(robot: str, names: Sequence[str]) -> Outcomes:
    """Return the outcomes of a robot's cases in this order, without those never played."""
    cases = kept(robot)["cases"]
    return {
        name: Outcome(**cases[name] | {"minutes": [Minute(**m) for m in cases[name]["minutes"]]})
        for name in names
        if name in cases
    }


def ideal_hand(robot: str) -> float | None:
    """Return the median distance of the hand with nothing spoilt, m; None if never played."""
    hands = kept(robot)["cases"].get("ideal", {}).get("hands")
    return float(np.median(hands)) if hands else None


# Page and picture


def rows_of_page() -> dict[tuple[str, str], Row]:
    """Return the rows of all tables of the page, by the heading above them and first cell."""
    heading = ""
    rows = {}
    for line in read_part(NAME).splitlines():
        if line.startswith("### "):
            heading = line.removeprefix("### ")
        elif line.startswith("| "):
            cells = tuple(cell.strip() for cell in line[1:-1].split("|"))
            rows[heading, cells[0]] = cells
    return rows


def draw(rows: Mapping[str, Mapping[str, Row]], titles: Mapping[str, str]) -> plt.Figure:
    """Return a picture of the largest violations by robot and case."""
    names = [name for name in titles if any(name in part for part in rows.values())]
    picture, axes = plt.subplots(
        2, len(rows), figsize=(4 + 3.2 * len(rows), 7), sharey=True, sharex="row",
        layout="constrained", squeeze=False,
    )  # fmt: skip
    kinds = (
        ("position, rad", "position beyond a limit, rad"),
        ("speed, rad/s", "speed beyond a limit, rad/s"),
    )
    for line, (head, label) in zip(axes, kinds, strict=True):
        column = HEADS.index(head)
        values = {r: {n: float(cells[column]) for n, cells in p.items()} for r, p in rows.items()}
        some = [v for part in values.values() for v in part.values() if v > 0.0] or [1e-3, 1.0]
        low = 10.0 ** np.floor(np.log10(min(some)) - 1.0)
        for axis, (robot, part) in zip(line, values.items(), strict=True):
            for name, value in part.items():
                place = names.index(name)
                color = _COLORS[_kind(name)]
                if value > 0.0:
                    axis.barh(place, value - low, left=low, color=color)
                    axis.text(value, place, f" {value:.2g}", va="center", fontsize=8)
                else:
                    axis.plot(1.6 * low, place, "o", mfc="none", color=color, clip_on=False)
            axis.set(xscale="log", xlim=(low, 30.0 * max(some)), xlabel=label)
            axis.set_yticks(range(len(names)), [titles[name] for name in names], fontsize=8)
            axis.grid(axis="x", alpha=0.3)
            if column == HEADS.index(kinds[0][0]):
                axis.set_title(robot)
    axes[0, 0].invert_yaxis()
    return picture


_COLORS = {"ideal": "tab:gray", "all": "tab:green", "less": "tab:red", "beyond": "tab:orange"}


def _kind(name: str) -> str:
    """Return the group of a case: a colour."""
    if name.startswith("ideal"):
        return "ideal"
    if name in WITHIN_DECLARED:
        return "all"
    return "beyond" if name == "twice" else "less"


def _cost_row(robot: str, name: str, titles: Mapping[str, str]) -> Row:
    """Return a row of the table of times; its first cell alone if the case was not played."""
    title = f"{robot}, {titles[name].partition(', ')[2]}"
    cost = kept(robot)["costs"].get(name)
    if cost is None:
        return (title,)
    times = (f"{t:.2f}" if t is not None else "-" for t in cost["times"])
    return (title, *times, f"{1e3 * cost['left']:.1f}")


def write_page(
    robots: Sequence[str],
    titles: Mapping[str, str],
    pushed: Mapping[str, Mapping[str, float]],
) -> None:
    """Write tables and picture of all rows, data and metrics of those whose numbers are kept.

    What docs/results.md has of other cases in `titles` stays as it is.

    Args:
        robots: in the order of the page.
        titles: of the cases by name, in the order of the rows.
        pushed: by robot, the forces by link, N.
    """
    before = rows_of_page()
    figure, costs = Figure(NAME), Figure(NAME)
    rows: dict[str, dict[str, Row]] = {}
    for robot in robots:
        part, hand = kept_outcomes(robot, list(titles)), ideal_hand(robot)
        known = {
            name: row(name, part[name], hand) if name in part else before.get((robot, title))
            for name, title in titles.items()
        }
        rows[robot] = {name: cells for name, cells in known.items() if cells is not None}
        for name, outcome in part.items():
            figure.data[f"{robot}_{name}_hand"] = np.array(outcome.hands)
            for kind in Minute.__dataclass_fields__:
                values = [getattr(minute, kind) for minute in outcome.minutes]
                figure.data[f"{robot}_{name}_{kind}"] = np.array(values)
                figure.metrics[f"{robot}_{name}_{kind}"] = outcome.worst(kind)
        for name in filter(lambda each: _kind(each) == "ideal", titles):
            cells = _cost_row(robot, name, titles)
            cells = cells if len(cells) > 1 else before.get((COSTS, cells[0]), ())
            costs.rows += [cells] if cells else []
    rows = {robot: part for robot, part in rows.items() if part}
    if not rows:
        return
    figure.save(draw(rows, titles))
    image = ROOT / "docs" / "images" / f"{NAME}.png"
    image.write_bytes((RESULTS / NAME / "figure.png").read_bytes())
    text = ""
    for robot, part in rows.items():
        links = ", ".join(f"`{link}` {force:g} N" for link, force in pushed[robot].items())
        text += f"### {robot}\n\nPushed: {links}.\n\n"
        text += table([Figure(NAME, rows=list(part.values()))], HEADS) + "\n\n"
    write_part(NAME, f"{text}### {COSTS}\n\n{table([costs], COST_HEADS)}")
