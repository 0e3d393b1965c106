# SPDX-License-Identifier: Apache-2.0
"""Ten minutes of a simulated FR3 at and beyond its limits, behind libfranka's protocol.

bash scripts/reproduce.sh fr3                        the table of docs/results.md
bash scripts/reproduce.sh fr3 --rows lockstep        one of its rows
bash scripts/reproduce.sh fr3 --minutes 1 --seed 3   the fourth minute alone

`scripts/demo.sh fr3` plays random goals and pushes; each minute has its own seed. Half of the time
a stiff posture task with little damping drives joints into their limits. Else poses come as well,
many out of reach. `simulated_fr3` judges each period. Rows that are not played stay on the page.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import yaml
from chain import ROOT, load_values
from direct import posture_at_limits
from figure import DIFFERS, RESULTS, Row, page_rows, table, write_part

PART = "fr3"
MINUTE = 60.0  # s
SHARE = 15.0
"""How long gains are kept, s."""
GAINS: tuple[dict[str, float], ...] = (
    {"posture_kp": 100.0, "posture_kd": 8.0, "posture_weight": 1.0, "pose_weight": 0.0},
    {"posture_kp": 10.0, "posture_kd": -1.0, "posture_weight": 1e-3, "pose_weight": 1.0},
)
"""Stiff postures with 0.4 of critical damping; then poses, with the gains of config/fr3.yaml."""
GOAL, PUSH, CUT = (0.3, 4.0), (0.2, 1.0), (2.0, 6.0)
"""How long goals and pushes last, and what is between losses of torque control, s."""
CUT_LASTS = 0.05  # s
FAR = 1.2
"""Half of the edges of the box that positions of poses are in, m; the arm reaches 0.9 m."""
LINKS = (*(f"fr3_link{k}" for k in range(2, 8)), "fr3_hand")
"""What is pushed."""
HEADS = (
    "course",
    "minutes",
    "position, rad",
    "speed, rad/s",
    "torque",
    "torque rate",
    "periods",
    "missed",
    "success rate",
    "bounds relaxed",
    "",
)


class Case(NamedTuple):
    """How a course is played.

    Attributes:
        title: of the row.
        options: of `scripts/demo.sh`.
        cuts: whether torque control is taken away now and then.
        promised: whether limits are to be kept.
    """

    title: str
    options: tuple[str, ...] = ()
    cuts: bool = False
    promised: bool = True


CASES = {
    "lockstep": Case("lockstep"),
    "cuts": Case("lockstep, torque control taken away", cuts=True),
    "real_time": Case("by the wall clock", ("--real-time",), promised=False),
}


def course(values: Mapping[str, Any], seed: int, force: float, cuts: bool) -> dict[str, Any]:
    """Return the scenario of a minute of random goals and pushes, the same for a seed.

    Args:
        values: parameters of the arm.
        seed: of the random numbers.
        force: largest one of pushes, N.
        cuts: whether torque control is taken away now and then.
    """
    rng = np.random.default_rng(seed)
    low, high = (np.array(values[f"position_{end}"]) for end in ("min", "max"))

    def times(between: tuple[float, float]) -> Iterator[float]:
        time = 0.0
        while time < MINUTE:
            yield time
            time += float(rng.uniform(*between))

    events: list[dict[str, Any]] = [
        {"time": time, "parameters": {"node": "controller_node", "values": GAINS[k % len(GAINS)]}}
        for k, time in enumerate(np.arange(0.0, MINUTE, SHARE).tolist())
    ]
    for time in times(GOAL):
        posture = posture_at_limits(rng, low, high).tolist()
        names = values["joints"]
        events.append({"time": time, "posture": dict(zip(names, posture, strict=True))})
        if int(time / SHARE) % 2 == 0:
            continue
        turn = rng.standard_normal(4)
        pose = {
            "position": rng.uniform(-FAR, FAR, 3).tolist(),
            "orientation": (turn / np.linalg.norm(turn)).tolist(),
        }
        events.append({"time": time, "pose": pose})
    for time in times((PUSH[1], 3.0 * PUSH[1])):
        direction = rng.standard_normal(3)
        size = rng.uniform(0.0, force) / np.linalg.norm(direction)
        push = {
            "link": LINKS[rng.integers(len(LINKS))],
            "force": (size * direction).tolist(),
            "duration": float(rng.uniform(*PUSH)),
        }
        events.append({"time": time, "push": push})
    if cuts:
        for time in list(times(CUT))[1:]:
            events.append({"time": time, "enable_torque": False})
            events.append({"time": time + CUT_LASTS, "enable_torque": True})
    return {"duration": MINUTE, "events": [e for e in events if e["time"] < MINUTE]}


def play(name: str, seed: int, force: float) -> dict[str, Any]:
    """Play a minute of a case; return the metrics of the run.

    Raises:
        SystemExit: it could not be played.
    """
    case, out = CASES[name], RESULTS / "fr3" / f"{name}_{seed}"
    out.mkdir(parents=True, exist_ok=True)
    scenario, parameters = out / "scenario.yaml", out / "parameters.yaml"
    scenario.write_text(yaml.safe_dump(course(load_values("fr3"), seed, force, case.cuts)))
    # All goals are sent at the start.
    ahead = {"/**/controller_node": {"ros__parameters": {"goal_ahead_max": 2.0 * MINUTE}}}
    parameters.write_text(yaml.safe_dump(ahead))
    demo = ["bash", str(ROOT / "scripts" / "demo.sh"), "fr3", str(scenario)]
    demo += ["--params", str(parameters), "--out", str(out), *case.options]
    status = subprocess.run(demo).returncode
    if status not in (0, 1):
        raise SystemExit(status)
    return json.loads((out / "metrics.json").read_text())


def machine() -> str:
    """Return what the machine is."""
    kernel = "a" if "PREEMPT_RT" in os.uname().version else "no"
    return f"{os.cpu_count()} processors, {kernel} real-time kernel"


def row(name: str, minutes: Sequence[Mapping[str, Any]]) -> Row:
    """Return a row of the table: the worst of some minutes' metrics, and the sums."""
    steps, missed, relaxed = (
        sum(each[key] for each in minutes)
        for key in ("steps", "deadline_misses", "bounds_relaxed_steps")
    )
    position, speed, torque, rate = (
        max(each[f"max_{key}"] for each in minutes)
        for key in (
            "position_violation_rad",
            "velocity_violation_rad_s",
            "torque_ratio",
            "torque_rate_ratio",
        )
    )
    kept = all(each["limits_kept"] for each in minutes)
    verdict = "kept" if kept else f"{DIFFERS}: a limit was passed"
    return (
        CASES[name].title,
        f"{len(minutes)}",
        f"{position:.2g}",
        f"{speed:.2g}",
        f"{torque:.3f}",
        f"{rate:.3f}",
        f"{steps}",
        f"{missed}",
        f"{1.0 - missed / steps:.3f}",
        f"{relaxed}",
        verdict if CASES[name].promised else machine(),
    )


def main() -> int:
    """Play the rows, write the table; return 1 where a promised limit was not kept."""
    parser = argparse.ArgumentParser(prog="reproduce.sh fr3", description=__doc__.splitlines()[0])
    parser.add_argument("--rows", nargs="+", default=list(CASES), choices=tuple(CASES))
    parser.add_argument("--minutes", type=int, default=10, help="of robot time (10)")
    parser.add_argument("--seed", type=int, default=0, help="of the first minute (0)")
    parser.add_argument("--force", type=float, default=20.0, help="of pushes at most, N (20)")
    given = parser.parse_args()
    rows = {title: cells for (_, title), cells in page_rows(PART).items()}
    for name in given.rows:
        seeds = range(given.seed, given.seed + given.minutes)
        cells = row(name, [play(name, seed, given.force) for seed in seeds])
        rows[cells[0]] = cells
        known = [rows[case.title] for case in CASES.values() if case.title in rows]
        write_part(PART, table(known, HEADS))
        print(*cells, sep=" | ", flush=True)
    played = [rows[CASES[name].title] for name in given.rows]
    return int(any(DIFFERS in cells[-1] for cells in played))


if __name__ == "__main__":
    raise SystemExit(main())
