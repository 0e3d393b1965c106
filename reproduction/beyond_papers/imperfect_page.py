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
from figure import RESULTS, Figure, table

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
PAGE = """\
# Results for imperfect robots

Written by `bash scripts/reproduce.sh imperfect`; do not edit. The real nodes in lockstep, on
robots whose states are late, coarse and noisy, whose commands are late or lost, and whose motors
are not what the model says: `config/imperfect/<robot>.yaml` has the values and their sources,
[simulated_robot.md](simulated_robot.md) their models. Numbers are under `results/imperfect/`.

![Largest violations by case](images/imperfect.png)

The largest violation of a position and of a speed limit in each case; a circle is none at all.
Grey: nothing is spoilt. Green: within what is declared, all done. Red: a remedy is missing.
Orange: beyond what is declared.

## How it is played

Each minute has random numbers of its own, the same in all cases. It has four rounds: nine goals of
a second each, and one that is kept for 6 s. A goal is a posture, and the pose of the hand in it;
each joint has it at one of its limits with a probability of one half. In every second round a
link is pushed once per second in a random direction; a push rises within 0.2 s and lasts for 0.2 s
more. In every second minute the posture task is so stiff (kp 100 1/s², alone) that it drives each
joint into its limits.

{pushes}

Remedies: the *observer* estimates velocities from positions, and the *prediction* takes the state
through the commands under way ([state_estimation.md](state_estimation.md)); *margins and horizon*
of the bounds follow from what is declared ([uncertainty.md](uncertainty.md)); the *stop* is that
of [stopping.md](stopping.md), the alternative are brakes. "Twice as much" has twice the delays,
errors, noise and longest row of lost commands, and half the bandwidths.

| column | |
|---|---|
| position, speed | farthest beyond a limit, any joint, true state, at each physics step |
| torque | largest true torque of a motor; more than 1 would be beyond its limit |
| torque step | largest change of a commanded torque from one control period to the next |
| at rest | the same in the last second of the goals that are kept, joints on limits included |
| hand at rest | distance from a goal 8 s after it was sent: median to largest |

An arm that moves by more than 20 mrad in that second is still on its way, as the filter may lead
it round what it cannot hold; then that second does not count.

A row of which something is promised ends with a verdict. Where what is spoilt is within what is
declared ("all done", also while commands fail and the drives stop by themselves, and with the
safety filter), position and speed must be 0 and torque at most 1. With "all done" alone, the step
at rest must also be at most {step:g}, and the median distance of the hand at most {factor:g} times
that of the same robot with nothing spoilt and nothing done, or what a step of all encoders is at
the hand. The other rows are for comparison.
Rows stay until they are played again: they may be of different versions of the project.

The *safety filter* ([whole_arm.md](whole_arm.md)) is on in all rows of `baxter_left_arm`, as in
its file, and elsewhere where a row says so. `torque_reserve` in the files is for the pushes above.
Panda's maker allows torques to change by 1000 N m/s.

Two things that a verdict does not say. It holds for the minutes, goals and pushes of its row, in
lockstep. Pushes and TALOS' friction are at times more than `acceleration_disturbance` declares:
what keeps the limits then are the disturbance observer and further margins in the files, which are
tested, not proven.
{parts}
## {costs_heading}

The rows "nothing spoilt" above have what they cost in violations and torque steps. The time that
they cost: all joints go together from the middle of their ranges to a limit and back, with the
stiff posture task, until all are within {near:g} mrad of the goal. Where "-" stands some joint
stays farther off than that, because of margins or because the torque does not suffice there; the
last column has the largest distance left at the limits.

{costs}

`bash scripts/bench.sh chain --imperfect` measures the time from a state to its command, without
and with the remedies.
"""


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


def page_path() -> Path:
    """Return where the page is."""
    return ROOT / "docs" / f"reproduction_{NAME}.md"


def rows_of_page() -> dict[tuple[str, str], Row]:
    """Return the rows of all tables of the page, by the heading above them and first cell."""
    path, heading = page_path(), ""
    rows = {}
    for line in path.read_text().splitlines() if path.exists() else ():
        if line.startswith("## "):
            heading = line.removeprefix("## ")
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
    near: float,
) -> None:
    """Write page and picture of all rows, data and metrics of those whose numbers are kept.

    What the page has of other cases in `titles` stays as it is.

    Args:
        robots: in the order of the page.
        titles: of the cases by name, in the order of the rows.
        pushed: by robot, the forces by link, N.
        near: how near a goal counts as reached, rad.
    """
    outcomes = {robot: kept_outcomes(robot, list(titles)) for robot in robots}
    if not any(outcomes.values()):
        return
    before = rows_of_page()
    figure, pushes, costs = Figure(NAME), Figure(NAME), Figure(NAME)
    rows: dict[str, dict[str, Row]] = {}
    for robot, part in outcomes.items():
        hand = ideal_hand(robot)
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
    figure.save(draw(rows, titles))
    image = ROOT / "docs" / "images" / f"{NAME}.png"
    image.write_bytes((RESULTS / NAME / "figure.png").read_bytes())
    parts = ""
    for robot, part in rows.items():
        one = Figure(NAME, rows=list(part.values()))
        parts += f"\n## {robot}\n\n{table([one], HEADS)}\n"
        links = (f"`{link}` {force:g} N" for link, force in pushed[robot].items())
        pushes.rows.append((robot, ", ".join(links)))
    page = PAGE.format(
        pushes=table([pushes], ("robot", "links that are pushed, and how hard")),
        step=STEP_AT_REST,
        factor=HAND_FACTOR,
        parts=parts,
        near=1e3 * near,
        costs_heading=COSTS,
        costs=table([costs], COST_HEADS),
    )
    page_path().write_text(page)
