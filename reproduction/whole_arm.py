# SPDX-License-Identifier: Apache-2.0
"""Arms with weak motors, with and without the safety filter: tables and pictures.

bash scripts/reproduce.sh whole_arm
bash scripts/reproduce.sh whole_arm --minutes 30     longer; 2 minutes of each row otherwise

Random postures that can be held, half of the joints at their limits; a new one every 6 s.
The posture task is stiff, so that the limits decide. Robot, bounds and controller are those of the
files, in one loop in lockstep, with exact states. The page is `docs/whole_arm.md`.
"""

from __future__ import annotations

import argparse
import os
import time
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import Any, NamedTuple

import matplotlib.pyplot as plt
import numpy as np
import pinocchio as pin
from chain import ROOT
from direct import DirectLoop, column
from figure import Figure, table, verdict

from viability_bounds_pkg.whole_arm.plan_torques import PlanTorques
from viability_bounds_pkg.whole_arm.safety_filter import RESERVE

STIFF = {"posture_kp": 100.0, "posture_kd": 20.0, "posture_weight": 1.0, "pose_weight": 0.0}
DATA_SHEET = [15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0]
"""Panda's largest accelerations by its maker, rad/s^2."""
FASTER = {"acceleration_min": [-a for a in DATA_SHEET], "acceleration_max": DATA_SHEET}
CASES: dict[str, tuple[str, float, dict[str, Any]]] = {
    "Baxter, without": ("baxter_left_arm", 1.0, {"safety_filter": False}),
    "Baxter": ("baxter_left_arm", 1.0, {}),
    "Panda, without": ("panda", 1.0, {"safety_filter": False}),
    "Panda": ("panda", 1.0, {}),
    "Panda, accelerations of the data sheet": ("panda", 1.0, FASTER),
    "Panda, 60% of its torque, without": ("panda", 0.6, {"safety_filter": False}),
    "Panda, 60% of its torque": ("panda", 0.6, {}),
    "TALOS": ("talos_left_arm", 1.0, {}),
    "TALOS, 60% of its torque, without": ("talos_left_arm", 0.6, {"safety_filter": False}),
    "TALOS, 60% of its torque": ("talos_left_arm", 0.6, {}),
}
"""Robot, share of its torque limits, and what differs from its file."""
EACH = 6.0  # s for a goal
NEAR = 0.01  # rad; the bounds' margins keep Baxter 4 mrad off its limits
KEPT_FREE = 0.05  # share of the torque limits that holding a goal leaves
SHOULDER, ELBOW = 1, 3


class Minute(NamedTuple):
    """What came of a minute of goals.

    Attributes:
        position, speed, torque: largest violations, rad and rad/s, and share of a torque limit.
        times: to each goal, s; NaN where it was not reached.
        outcomes: of the filter, by kind.
    """

    position: float
    speed: float
    torque: float
    times: list[float]
    outcomes: Counter[str]


def make_loop(case: str) -> DirectLoop:
    """Return the arm of a case."""
    robot, share, changed = CASES[case]
    tau_max = DirectLoop(robot).config.torque_max
    return DirectLoop(
        robot,
        STIFF | {"safety_filter": True, "torque_max": (share * tau_max).tolist()} | changed,
    )


def goals(loop: DirectLoop, seed: int) -> list[np.ndarray]:
    """Return the goals of a minute."""
    rng, data = np.random.default_rng(seed), loop.model.createData()
    low, high = loop.limits.q_min, loop.limits.q_max
    found: list[np.ndarray] = []
    while len(found) < round(60.0 / EACH):
        ends = np.where(rng.random(low.size) < 0.5, low, high)
        goal = np.where(rng.random(low.size) < 0.5, ends, rng.uniform(low, high))
        held = np.abs(pin.computeGeneralizedGravity(loop.model, data, goal))
        if (held <= (1.0 - KEPT_FREE) * loop.config.torque_max).all():
            found.append(goal)
    return found


def play(case: str, seed: int) -> Minute:
    """Play a minute."""
    loop = make_loop(case)
    times: list[float] = []
    for goal in goals(loop, seed):
        loop.controller.set_posture_goal(goal)
        off = np.abs(column(loop.run(EACH), "q") - goal).max(axis=1)
        away = np.flatnonzero(off > NEAR)
        arrived = 0 if away.size == 0 else int(away[-1]) + 1
        times.append(arrived * loop.dt if arrived < off.size else float("nan"))
    monitor, keeper = loop.robot.monitor, loop.controller.safety_filter
    return Minute(
        float(monitor.max_position_violation.max()),
        float(monitor.max_velocity_violation.max()),
        float(monitor.max_torque_ratio.max()),
        times,
        Counter() if keeper is None else keeper.outcomes,
    )


def compare(figure: Figure, minutes: int) -> bool:
    """Play all cases, fill in their rows; return whether the filter kept all limits."""
    kept = True
    with ProcessPoolExecutor(os.cpu_count(), get_context("spawn")) as pool:
        runs = {case: [pool.submit(play, case, s) for s in range(minutes)] for case in CASES}
        for case, futures in runs.items():
            played = [future.result() for future in futures]
            position, speed, torque = (
                max(getattr(minute, name) for minute in played)
                for name in ("position", "speed", "torque")
            )
            times = np.array([time for minute in played for time in minute.times])
            outcomes: Counter[str] = sum((minute.outcomes for minute in played), Counter())
            fine = position == 0.0 and speed == 0.0 and torque <= 1.0 + 1e-9
            filtered = bool(outcomes)
            kept &= fine or not filtered
            share = 1.0 - outcomes["as wanted"] / max(outcomes.total(), 1)
            figure.metrics |= {
                f"{case}: position": position,
                f"{case}: speed": speed,
                f"{case}: reached": float(np.isfinite(times).mean()),
                f"{case}: time": float(np.nanmedian(times)),
            }
            figure.rows.append(
                (
                    case,
                    f"{minutes} min",
                    f"{position:.2g}",
                    f"{speed:.2g}",
                    f"{torque:.3f}",
                    f"{np.isfinite(times).sum()} of {times.size}",
                    f"{np.nanmedian(times):.2f} s",
                    f"{share:.2%}" if filtered else "-",
                    verdict(fine, "kept") if filtered else "",
                )
            )
            print(*figure.rows[-1], sep=" | ", flush=True)
    return kept


def shoulder(axis: plt.Axes, seed: int = 4) -> None:
    """Draw Baxter's shoulder on its way to random goals, 3 s each, with and without."""
    for label, colour, filtered in (("without", "tab:red", False), ("with", "tab:green", True)):
        loop = DirectLoop("baxter_left_arm", STIFF | {"safety_filter": filtered})
        rng = np.random.default_rng(seed)
        low, high = loop.limits.q_min, loop.limits.q_max
        for _ in range(10):
            ends = np.where(rng.random(low.size) < 0.5, low, high)
            goal = np.where(rng.random(low.size) < 0.5, ends, rng.uniform(low, high))
            loop.controller.set_posture_goal(goal)
            samples = loop.run(3.0)
        del samples
        t = np.arange(len(loop.samples)) * loop.dt
        q = column(tuple(loop.samples), "q")[:, SHOULDER]
        axis.plot(t, q, color=colour, label=f"{label} the filter")
    for limit in (low[SHOULDER], high[SHOULDER]):
        axis.axhline(limit, color="k", linewidth=0.8)
    axis.set(xlabel="time, s", ylabel="left_s1, rad", title="Baxter's shoulder")
    axis.legend(loc="lower right")


def safe_set(axis: plt.Axes, elbow: float) -> None:
    """Draw from which states of the shoulder a safe plan is known, and the joint's own kernel."""
    loop = DirectLoop("baxter_left_arm")
    limits, n = loop.limits, len(loop.limits)
    braking = np.minimum(-limits.a_min, limits.a_max)
    plans = PlanTorques(
        loop.model,
        limits.q_min,
        limits.q_max,
        braking,
        (1.0 - RESERVE) * loop.config.torque_max,
        loop.dt,
        np.full(n, 1e-6),
    )
    places = np.linspace(limits.q_min[SHOULDER], limits.q_max[SHOULDER], 161)
    speeds = np.linspace(-limits.v_max[SHOULDER], limits.v_max[SHOULDER], 121)
    q, v, zero = np.zeros(n), np.zeros(n), np.zeros(n)
    q[ELBOW] = elbow
    safe = np.zeros((speeds.size, places.size), dtype=bool)
    for k, place in enumerate(places):
        for i, speed in enumerate(speeds):
            q[SHOULDER], v[SHOULDER] = place, speed
            safe[i, k] = any(
                plans.plan(q, v, T, zero) >= 0.0 and plans.beyond <= 0.0
                for T in np.geomspace(loop.dt, 1.5, 12)
            )
    axis.contourf(places, speeds, safe, levels=[0.5, 1.5], colors=["tab:green"], alpha=0.4)
    for sign, end in ((1.0, limits.q_max[SHOULDER]), (-1.0, limits.q_min[SHOULDER])):
        curve = np.sqrt(2.0 * braking[SHOULDER] * np.abs(end - places))
        axis.plot(places, sign * np.minimum(curve, limits.v_max[SHOULDER]), "k--", linewidth=1)
    axis.set(
        xlabel="left_s1, rad",
        ylabel="its speed, rad/s",
        title=f"where a safe plan is known, elbow at {elbow:g} rad",
    )


def cost(robot: str, states: int = 300) -> tuple[float, float]:
    """Return how long the filter takes in random states, median and 99%, us."""
    loop = DirectLoop(robot, {"safety_filter": True})
    keeper, limits, n = loop.controller.safety_filter, loop.limits, len(loop.limits)
    assert keeper is not None
    rng, zero, taken = np.random.default_rng(0), np.zeros(n), []
    for _ in range(states):
        q = rng.uniform(limits.q_min, limits.q_max)
        v, a = 0.3 * rng.uniform(-limits.v_max, limits.v_max), rng.uniform(-1.0, 1.0, n)
        keeper.reset()
        begin = time.perf_counter()
        keeper.look(q, v, zero, limits.a_min, limits.a_max)
        keeper.choose(a)
        taken.append(1e6 * (time.perf_counter() - begin))
    return float(np.median(taken)), float(np.percentile(taken, 99))


def main() -> int:
    """Play, draw, print the table; return whether the filter kept all limits."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=int, default=2, help="of each row")
    given = parser.parse_args()
    figure = Figure("whole_arm")
    kept = compare(figure, given.minutes)
    picture, axes = plt.subplots(1, 3, figsize=(16, 4.6), layout="constrained")
    shoulder(axes[0])
    safe_set(axes[1], 0.0)
    safe_set(axes[2], 1.5)
    picture.savefig(ROOT / "docs" / "images" / "whole_arm.png", dpi=90)
    figure.save(picture)
    heads = ("arm", "played", "position, rad", "speed, rad/s", "torque", "goals reached")
    print("\n" + table([figure], (*heads, "median time", "steps changed", "")))
    for robot in ("panda", "baxter_left_arm", "talos_left_arm"):
        median, slow = cost(robot)
        print(f"{robot}: the filter takes {median:.0f} us of a step in the median, 99% {slow:.0f}")
    return 0 if kept else 1


if __name__ == "__main__":
    raise SystemExit(main())
