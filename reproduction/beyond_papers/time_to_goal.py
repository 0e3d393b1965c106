# SPDX-License-Identifier: Apache-2.0
"""How soon Panda is at its goals, with the accelerations that each kind of limits can promise.

bash scripts/reproduce.sh time_to_goal
bash scripts/reproduce.sh time_to_goal --goals 100     more of them; 20 of each kind otherwise

Random postures, and short moves, every joint by up to 0.3 rad. The posture task is stiff, so that
the limits decide. A goal is reached when all joints stay within 10 mrad. The bounds get the
jerk under held torque that belongs to each row's accelerations and speeds.
"""

from __future__ import annotations

import argparse
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
from direct import DirectLoop
from figure import Figure, table, verdict
from pieces import in_pieces
from whole_arm import CLEAR, DATA_SHEET, KEPT_FREE, arrive, random_goal

from viability_bounds_pkg.estimation.discretisation_margin import discretisation_margin

ROBOT = "panda"
STIFF = {"posture_kp": 400.0, "posture_kd": 40.0, "posture_weight": 1.0, "pose_weight": 0.0}
SPEEDS = [2.175, 2.175, 2.175, 2.175, 2.61, 2.61, 2.61]
"""Of Panda's URDF and data sheet, rad/s; its file has 0.77 of them."""
SHORT = 0.3  # rad
LIMIT = 6.0  # s
TOGETHER = 10
"""Goals of a piece of work."""


class Limits(NamedTuple):
    """A row of the table."""

    filtered: bool
    accelerations: list[float] | None = None
    """rad/s^2; None for those of the file."""
    speeds: list[float] | None = None
    """rad/s; None for those of the file."""


ROWS = {
    "worst case": Limits(False),
    "filter": Limits(True),
    "filter, data sheet": Limits(True, DATA_SHEET),
    "filter, twice the data sheet": Limits(True, [2.0 * a for a in DATA_SHEET]),
    "filter, data sheet and its speeds": Limits(True, DATA_SHEET, SPEEDS),
    "filter, twice the data sheet, its speeds": Limits(
        True, [2.0 * a for a in DATA_SHEET], SPEEDS
    ),
    "without filter, twice the data sheet, its speeds": Limits(
        False, [2.0 * a for a in DATA_SHEET], SPEEDS
    ),
}


def parameters(row: Limits) -> dict[str, Any]:
    """Return what differs from the file."""
    file = DirectLoop(ROBOT)
    limits, config = file.limits, file.config
    a_max = limits.a_max if row.accelerations is None else np.array(row.accelerations)
    v_max = config.velocity_max if row.speeds is None else np.array(row.speeds)
    found = discretisation_margin(
        file.model,
        limits.q_min,
        limits.q_max,
        v_max,
        -a_max,
        a_max,
        config.torque_max,
        config.dt,
    )
    return STIFF | {
        "safety_filter": row.filtered,
        "acceleration_min": (-a_max).tolist(),
        "acceleration_max": a_max.tolist(),
        "velocity_max": v_max.tolist(),
        "acceleration_drift": (1.1 * found.jerk).tolist(),
    }


def near_goal(loop: DirectLoop, rng: np.random.Generator) -> np.ndarray:
    """Return a posture within a short move that can be held."""
    data, q = loop.model.createData(), loop.robot.state().q
    low, high = loop.limits.q_min + CLEAR, loop.limits.q_max - CLEAR
    while True:
        goal = np.clip(q + rng.uniform(-SHORT, SHORT, q.size), low, high)
        held = np.abs(pin.computeGeneralizedGravity(loop.model, data, goal))
        if (held <= (1.0 - KEPT_FREE) * loop.config.torque_max).all():
            return goal


def play(name: str, seed: int) -> dict[str, Any]:
    """Go to some goals of each kind; return the times to them, s, and violations."""
    row = ROWS[name]
    loop, rng = DirectLoop(ROBOT, parameters(row)), np.random.default_rng(seed)
    times: dict[str, list[float]] = {"far": [], "short": []}
    for _ in range(TOGETHER):
        times["far"].append(arrive(loop, "posture", random_goal(loop, rng, 0.0), LIMIT)[0])
        times["short"].append(arrive(loop, "posture", near_goal(loop, rng), LIMIT)[0])
    monitor, keeper = loop.robot.monitor, loop.controller.safety_filter
    return {
        "times": times,
        "position": float(monitor.max_position_violation.max()),
        "speed": float(monitor.max_velocity_violation.max()),
        "torque": float(monitor.max_torque_ratio.max()),
        "changed": 0.0
        if keeper is None
        else 1.0 - keeper.outcomes["as wanted"] / keeper.outcomes.total(),
    }


def main() -> int:
    """Play, print the table; return whether the filter kept all limits."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--goals", type=int, default=20, help="of each kind")
    given = parser.parse_args()
    seeds = range(max(given.goals // TOGETHER, 1))
    played: dict[str, list[dict[str, Any]]] = {name: [] for name in ROWS}
    figure, kept = Figure("time_to_goal"), True
    for (name, _), result in in_pieces(
        "time_to_goal", play, [(name, seed) for name in ROWS for seed in seeds]
    ):
        played[name].append(result)
        if len(played[name]) < len(seeds):
            continue
        results = played[name]
        worst = {
            key: max(each[key] for each in results) for key in ("position", "speed", "torque")
        }
        fine = worst["position"] == 0.0 and worst["speed"] == 0.0 and worst["torque"] <= 1.0 + 1e-9
        kept &= fine or not ROWS[name].filtered
        cells = []
        for kind in ("far", "short"):
            times = np.array([t for each in results for t in each["times"][kind]])
            times = np.where(np.isnan(times), np.inf, times)
            median, slow = np.percentile(times, (50, 90), method="higher")
            cells += [f"{median:.2f}", f"{slow:.2f}"]
            figure.metrics |= {
                f"{name}: {kind}": float(median),
                f"{name}: {kind}, 90%": float(slow),
            }
        changed = float(np.mean([each["changed"] for each in results]))
        figure.metrics |= {f"{name}: {key}": value for key, value in worst.items()}
        figure.rows.append(
            (
                name,
                *cells,
                f"{worst['position']:.2g}",
                f"{worst['speed']:.2g}",
                f"{worst['torque']:.3f}",
                f"{changed:.2%}" if ROWS[name].filtered else "-",
                verdict(fine, "kept") if ROWS[name].filtered else "kept" if fine else "passed",
            )
        )
        print(*figure.rows[-1], sep=" | ", flush=True)
    figure.save(None)
    heads = ("Panda's limits", "far, s", "90%", "short, s", "90%", "position, rad", "speed, rad/s")
    print("\n" + table([figure], (*heads, "torque", "steps changed", "")))
    return 0 if kept else 1


if __name__ == "__main__":
    raise SystemExit(main())
