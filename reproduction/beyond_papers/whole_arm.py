# SPDX-License-Identifier: Apache-2.0
"""Arms with weak motors, with and without the safety filter: tables and pictures.

bash scripts/reproduce.sh whole_arm                  2 minutes of each row
bash scripts/reproduce.sh whole_arm --row Panda      rows whose names contain it

In turns, random postures that can be held, half of the joints next to their limits, and poses of
the hand in random postures, not all of which can be reached from where the arm is without
planning. The next goal comes when the arm has been at rest at one, or after the time limit.
The tasks are stiff, so that the limits decide. Robot, bounds and controller are those of the
files, in one loop in lockstep, with exact states. The table is in docs/results.md.
"""

from __future__ import annotations

import argparse
import os
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pinocchio as pin
from direct import DirectLoop, column
from figure import DIFFERS, Figure, table, write_part

from torque_safety_controller.parts.whole_arm.braking_plan import (
    RESERVE,
    PlanLimits,
    PlanTorques,
    braking_periods,
)
from torque_safety_controller.parts.whole_arm.safety_filter import SafetyFilter

PART = "whole-arm"
HEADS = ("arm", "position, rad", "speed, rad/s", "torque", "steps changed", "")
POSTURE = {"posture_kp": 100.0, "posture_kd": 20.0, "posture_weight": 1.0, "pose_weight": 0.0}
"""Gains on the way to postures."""
POSE: dict[str, Any] = {"pose_kp": 100.0, "pose_kd": 20.0, "posture_kp": 10.0, "posture_kd": -1.0}
POSE |= {"pose_weight": 1.0, "posture_weight": 1e-5, "pose_error": "logarithm"}
"""Gains on the way to poses; damping of the posture is critical. The logarithm for all arms."""
OWN = {"pose_kp": 900.0, "pose_kd": 50.0, "posture_kp": 0.0, "posture_kd": 5.0}
AGAINST_FRICTION: dict[str, dict[str, Any]] = {
    "posture": POSTURE | {"posture_kp": 900.0, "posture_kd": 50.0, "friction_compensation": 0.9},
    "pose": OWN | {"pose_weight": 1.0, "posture_weight": 1e-3, "friction_compensation": 0.9},
}
"""TALOS': those of its file, the joints as stiff as the hand. Its integral action alone ends in
stick-slip, 2 mrad to and fro, and what pulls at the null space sticks and slips as well."""
SHORT = 4
"""Minutes of rows without the filter, at most."""
CLEAR = 0.005
"""Distance of goals from position limits, rad: the bounds' margins keep Baxter 4 mrad off them."""
KEPT_FREE = 0.05
"""Share of the torque limits that holding a goal leaves."""
AT = {"posture": (0.001,), "pose": (0.001, 0.005)}
"""When an arm is at a goal: rad of each joint; m and rad of the hand."""
STILL, REST = 0.01, 0.3
"""Speed below which an arm is at rest, rad/s, and how long it is to be before the next goal, s."""
SHOULDER, ELBOW = 1, 3


ARMS = {
    "Baxter": ("baxter_left_arm", 1.0),
    "Panda": ("panda", 1.0),
    "TALOS": ("talos_left_arm", 1.0),
    "Panda, 60% of its torque": ("panda", 0.6),
    "TALOS, 60% of its torque": ("talos_left_arm", 0.6),
}
"""Files, and the share of the torque limits that is left."""
CASES = {
    arm + ("" if filtered else ", without"): (*own, filtered)
    for arm, own in ARMS.items()
    for filtered in (True, False)
}


def make_loop(robot: str, share: float, filtered: bool) -> DirectLoop:
    """Return the arm of a case."""
    tau_max = DirectLoop(robot).config.torque_max
    own = {"safety_filter": filtered, "torque_max": (share * tau_max).tolist()}
    return DirectLoop(robot, POSTURE | own)


def random_goal(loop: DirectLoop, rng: np.random.Generator, at_limits: float = 0.5) -> np.ndarray:
    """Return a posture that can be held, with a share of its joints next to their limits."""
    data = loop.model.createData()
    low, high = loop.limits.q_min + CLEAR, loop.limits.q_max - CLEAR
    while True:
        ends = np.where(rng.random(low.size) < 0.5, low, high)
        goal = np.where(rng.random(low.size) < at_limits, ends, rng.uniform(low, high))
        held = np.abs(pin.computeGeneralizedGravity(loop.model, data, goal))
        if (held <= (1.0 - KEPT_FREE) * loop.config.torque_max).all():
            return goal


def visit(loop: DirectLoop, goals: str, posture: np.ndarray, limit: float) -> None:
    """Go to a posture, or where the hand is in it, until the arm rests there or time is over."""
    if goals == "posture":
        loop.controller.goals.set_posture(posture)
    else:
        data = loop.model.createData()
        pin.framesForwardKinematics(loop.model, data, posture)
        frame = loop.model.getFrameId(loop.controller.robot.frame)
        loop.controller.goals.set_pose(data.oMf[frame].copy())
    resting, end = 0, loop.t + limit
    while loop.t < end and resting * loop.dt < REST:
        loop.step()
        sample = loop.samples[-1]
        if goals == "posture":
            off = np.abs(sample.q - posture).max(keepdims=True)
        else:
            off = np.linalg.norm(sample.error.reshape(2, 3), axis=1)
        still = (off <= AT[goals]).all() and np.abs(sample.v).max() < STILL
        resting = resting + 1 if still else 0
    loop.samples.clear()


def play(name: str, seed: int, limit: float, duration: float = 60.0) -> dict[str, Any]:
    """Play random goals for a minute; return violations and what the filter did."""
    loop, rng = make_loop(*CASES[name]), np.random.default_rng(seed)
    gains = AGAINST_FRICTION if "TALOS" in name else {"posture": POSTURE, "pose": POSE}
    while loop.t < duration:
        for goals, own in gains.items():
            loop.change(**own)
            visit(loop, goals, random_goal(loop, rng, 0.5 if goals == "posture" else 0.0), limit)
    monitor, keeper = loop.robot.monitor, loop.controller.find(SafetyFilter)
    return {
        "position": float(monitor.max_position_violation.max()),
        "speed": float(monitor.max_velocity_violation.max()),
        "torque": float(monitor.max_torque_ratio.max()),
        "outcomes": {} if keeper is None else dict(keeper.outcomes),
    }


def compare(figure: Figure, minutes: int, limit: float, word: str) -> None:
    """Play all cases whose names contain a word; fill in their rows, and print them."""
    names = [name for name in CASES if word in name]
    with ProcessPoolExecutor(os.cpu_count(), get_context("spawn")) as pool:
        runs = {
            name: [
                pool.submit(play, name, seed, limit)
                for seed in range(minutes if CASES[name][-1] else min(minutes, SHORT))
            ]
            for name in names
        }
        for name, futures in runs.items():
            add_row(figure, name, [each.result() for each in futures])
            print(*figure.rows[-1], sep=" | ", flush=True)


def add_row(figure: Figure, name: str, minutes: list[dict[str, Any]]) -> None:
    """Add the row of a case, with a verdict if the filter is on."""
    position, speed, torque = (
        max(minute[key] for minute in minutes) for key in ("position", "speed", "torque")
    )
    outcomes: Counter[str] = sum((Counter(minute["outcomes"]) for minute in minutes), Counter())
    fine = position == 0.0 and speed == 0.0 and torque <= 1.0 + 1e-9
    filtered = CASES[name][-1]
    share = 1.0 - outcomes["as wanted"] / max(outcomes.total(), 1)
    figure.metrics |= {f"{name}: position": position, f"{name}: speed": speed}
    figure.add(
        name,
        f"{position:.2g}",
        f"{speed:.2g}",
        f"{torque:.3f}",
        f"{share:.2%}" if filtered else "-",
        holds=fine or not filtered,
        so="kept" if filtered else "",
    )


def shoulder(axis: plt.Axes, seed: int = 4) -> None:
    """Draw Baxter's shoulder on its way to random goals, 3 s each, with and without."""
    for label, colour, filtered in (("without", "tab:red", False), ("with", "tab:green", True)):
        loop = DirectLoop("baxter_left_arm", POSTURE | {"safety_filter": filtered})
        rng = np.random.default_rng(seed)
        low, high = loop.limits.q_min, loop.limits.q_max
        for _ in range(10):
            ends = np.where(rng.random(low.size) < 0.5, low, high)
            goal = np.where(rng.random(low.size) < 0.5, ends, rng.uniform(low, high))
            loop.controller.goals.set_posture(goal)
            loop.run(3.0)
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
    none = limits.velocity_offset, limits.deceleration_limit
    kept = PlanLimits(limits.q_min, limits.q_max, np.full(n, 1e-6), braking, loop.dt, *none)
    tau_max = (1.0 - RESERVE) * loop.config.torque_max
    torques, times = PlanTorques(loop.model, kept, tau_max), np.geomspace(loop.dt, 1.5, 12)
    places = np.linspace(limits.q_min[SHOULDER], limits.q_max[SHOULDER], 161)
    speeds = np.linspace(-limits.v_max[SHOULDER], limits.v_max[SHOULDER], 121)
    q, v, zero = np.zeros(n), np.zeros(n), np.zeros(n)
    q[ELBOW] = elbow
    safe = np.zeros((speeds.size, places.size), dtype=bool)
    for k, place in enumerate(places):
        for i, speed in enumerate(speeds):
            q[SHOULDER], v[SHOULDER] = place, speed
            plans = torques.evaluate(q, v, braking_periods(q, v, times, kept), zero)
            safe[i, k] = ((plans.slack >= 0.0) & (plans.beyond <= 0.0)).any()
    axis.contourf(places, speeds, safe, levels=[0.5, 1.5], colors=["tab:green"], alpha=0.4)
    for sign, end in ((1.0, limits.q_max[SHOULDER]), (-1.0, limits.q_min[SHOULDER])):
        curve = np.sqrt(2.0 * braking[SHOULDER] * np.abs(end - places))
        axis.plot(places, sign * np.minimum(curve, limits.v_max[SHOULDER]), "k--", linewidth=1)
    axis.set(
        xlabel="left_s1, rad",
        ylabel="its speed, rad/s",
        title=f"safe plans, elbow at {elbow:g} rad",
    )


def main() -> int:
    """Play, draw, print the table; return whether the filter kept all limits."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=int, default=2, help="of each row")
    parser.add_argument("--limit", type=float, default=30.0, help="time for a goal, s")
    parser.add_argument("--row", default="", help="rows whose names contain this alone")
    given = parser.parse_args()
    figure = Figure("whole_arm")
    compare(figure, given.minutes, given.limit, given.row)
    wrong = int(any(DIFFERS in cells[-1] for cells in figure.rows))
    if given.row:
        return wrong
    write_part(PART, table(figure.rows, HEADS))
    picture, axes = plt.subplots(1, 3, figsize=(12.5, 4.0), layout="constrained")
    shoulder(axes[0])
    safe_set(axes[1], 0.0)
    safe_set(axes[2], 1.5)
    figure.save(picture, "whole_arm")
    return wrong


if __name__ == "__main__":
    raise SystemExit(main())
