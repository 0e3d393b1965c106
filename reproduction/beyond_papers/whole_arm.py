# SPDX-License-Identifier: Apache-2.0
"""Arms with weak motors, with and without the safety filter: tables and pictures.

bash scripts/reproduce.sh whole_arm
bash scripts/reproduce.sh whole_arm --minutes 30     longer; 2 minutes of each row otherwise
bash scripts/reproduce.sh whole_arm --row Panda      rows whose names contain it
bash scripts/reproduce.sh whole_arm --limit 6        s that an arm has for a goal, 30 otherwise

In turns, random postures that can be held, half of the joints next to their limits, and poses of
the hand in random postures, not all of which can be reached from where the arm is without
planning. The next goal comes when the arm has been at rest at one, or after the time limit.
The tasks are stiff, so that the limits decide. Robot, bounds and controller are those of the
files, in one loop in lockstep, with exact states. The table is in docs/results.md. What is done is
kept in results/whole_arm/ until a source file changes.
"""

from __future__ import annotations

import argparse
from collections import Counter
from typing import Any, NamedTuple

import matplotlib.pyplot as plt
import numpy as np
import pinocchio as pin
from chain import ROOT
from direct import DirectLoop, column
from figure import Figure, table, verdict, write_part
from pieces import in_pieces

from torque_safety_controller.parts.whole_arm.braking_plan import (
    RESERVE,
    PlanLimits,
    PlanTorques,
    braking_periods,
)
from torque_safety_controller.parts.whole_arm.safety_filter import SafetyFilter

POSTURE = {"posture_kp": 100.0, "posture_kd": 20.0, "posture_weight": 1.0, "pose_weight": 0.0}
"""Gains on the way to postures."""
POSE: dict[str, Any] = {"pose_kp": 100.0, "pose_kd": 20.0, "posture_kp": 10.0, "posture_kd": -1.0}
POSE |= {"pose_weight": 1.0, "posture_weight": 1e-5, "pose_error": "logarithm"}
"""Gains on the way to poses; damping of the posture is critical. The logarithm for all arms."""
AGAINST_FRICTION = {
    "posture": POSTURE | {"posture_kp": 900.0, "posture_kd": 50.0, "friction_compensation": 0.9},
    "pose": {
        "pose_kp": 900.0,
        "pose_kd": 50.0,
        "posture_kp": 0.0,
        "posture_kd": 5.0,
        "pose_weight": 1.0,
        "posture_weight": 1e-3,
        "friction_compensation": 0.9,
    },
}
"""TALOS': those of its file, the joints as stiff as the hand. Its integral action alone ends in
stick-slip, 2 mrad to and fro, and what pulls at the null space sticks and slips as well."""
DATA_SHEET = [15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0]
"""Panda's largest accelerations by its maker, rad/s^2."""
SHORT = 4
"""Minutes of rows without the filter, at most."""
CLEAR = 0.005
"""Distance of goals from position limits, rad: the bounds' margins keep Baxter 4 mrad off them."""
KEPT_FREE = 0.05
"""Share of the torque limits that holding a goal leaves."""
NEAR = {"posture": (0.01,), "pose": (0.01, 0.05)}
"""Tolerances of goals: rad of each joint; m and rad of the hand. `AT` is the closer one."""
AT = {"posture": (0.001,), "pose": (0.001, 0.005)}
STILL, REST = 0.01, 0.3
"""Speed below which an arm is at rest, rad/s, and how long it is to be before the next goal, s."""
SHOULDER, ELBOW = 1, 3


class Case(NamedTuple):
    """A row of the table.

    Attributes:
        robot: its file.
        share: of its torque limits.
        changed: what differs from its file.
    """

    robot: str
    share: float = 1.0
    changed: dict[str, Any] = {}

    @property
    def filtered(self) -> bool:
        """Whether the safety filter is on."""
        return bool(self.changed.get("safety_filter", True))


WITHOUT = {"safety_filter": False}
ARMS = {
    "Baxter": ("baxter_left_arm", 1.0),
    "Panda": ("panda", 1.0),
    "TALOS": ("talos_left_arm", 1.0),
    "Panda, 60% of its torque": ("panda", 0.6),
    "TALOS, 60% of its torque": ("talos_left_arm", 0.6),
}
CASES: dict[str, Case] = {}
for _arm, (_robot, _share) in ARMS.items():
    CASES[_arm] = Case(_robot, _share)
    CASES[f"{_arm}, without"] = Case(_robot, _share, WITHOUT)


def make_loop(case: Case) -> DirectLoop:
    """Return the arm of a case."""
    tau_max = DirectLoop(case.robot).config.torque_max
    own = {"safety_filter": True, "torque_max": (case.share * tau_max).tolist()}
    return DirectLoop(case.robot, POSTURE | own | case.changed)


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


class Errors:
    """How far an arm is off its goal.

    Args:
        loop: of the arm.
        goals: "posture" or "pose".
        goal: a posture; for poses, one of those with the hand where it is to go.
    """

    def __init__(self, loop: DirectLoop, goals: str, goal: np.ndarray) -> None:
        self._loop, self._goal = loop, goal if goals == "posture" else None
        if goals == "posture":
            loop.controller.goals.set_posture(goal)
        else:
            data = loop.model.createData()
            pin.framesForwardKinematics(loop.model, data, goal)
            frame = loop.model.getFrameId(loop.controller.robot.frame)
            loop.controller.goals.set_pose(data.oMf[frame].copy())

    def now(self) -> np.ndarray:
        """Return the largest of a joint, rad; or those of the hand, m and rad."""
        loop = self._loop
        sample = loop.samples[-1]
        if self._goal is not None:
            return np.abs(sample.q - self._goal).max(keepdims=True)
        return np.linalg.norm(sample.error.reshape(2, 3), axis=1)


def arrive(loop: DirectLoop, goals: str, goal: np.ndarray, limit: float) -> tuple[float, float]:
    """Go to a goal; return when the arm was near and at it for good, s, NaN where it was not."""
    errors, steps = Errors(loop, goals, goal), round(limit / loop.dt)
    last = {"near": 0, "at": 0}  # steps in which it was not there
    resting = 0
    for k in range(steps):
        loop.step()
        off = errors.now()
        for name, tolerance in (("near", NEAR[goals]), ("at", AT[goals])):
            if not (off <= tolerance).all():
                last[name] = k + 1
        still = last["at"] <= k and float(np.abs(loop.samples[-1].v).max()) < STILL
        resting = resting + 1 if still else 0
        if resting * loop.dt >= REST:
            steps = k + 1
            break
    loop.samples.clear()
    near, at = (t * loop.dt if t < steps else float("nan") for t in last.values())
    return near, at


def play(name: str, seed: int, limit: float, duration: float = 60.0) -> dict[str, Any]:
    """Play random goals for a minute; return violations, times and what the filter did."""
    case = CASES[name]
    loop, rng = make_loop(case), np.random.default_rng(seed)
    gains = {"posture": POSTURE, "pose": POSE}
    if case.robot == "talos_left_arm":
        gains = AGAINST_FRICTION
    times: dict[str, list[tuple[float, float]]] = {goals: [] for goals in gains}
    while loop.t < duration:
        for goals, own in gains.items():
            loop.change(**own)
            goal = random_goal(loop, rng, 0.5 if goals == "posture" else 0.0)
            times[goals].append(arrive(loop, goals, goal, limit))
    monitor, keeper = loop.robot.monitor, loop.controller.find(SafetyFilter)
    return {
        "position": float(monitor.max_position_violation.max()),
        "speed": float(monitor.max_velocity_violation.max()),
        "torque": float(monitor.max_torque_ratio.max()),
        "seconds": loop.t,
        "times": times,
        "outcomes": {} if keeper is None else dict(keeper.outcomes),
    }


def compare(figure: Figure, minutes: int, limit: float, word: str) -> bool:
    """Play all cases, fill in their rows; return whether the filter kept all limits."""
    kept = True
    names = [name for name in CASES if word in name]
    seeds = {
        name: range(minutes if case.filtered else min(minutes, SHORT))
        for name, case in CASES.items()
        if name in names
    }
    pieces = [(name, seed, limit) for name in names for seed in seeds[name]]
    played: dict[str, list[dict[str, Any]]] = {name: [] for name in names}
    for (name, *_), minute in in_pieces("whole_arm", play, pieces):
        played[name].append(minute)
        if len(played[name]) == len(seeds[name]):
            kept &= add_row(figure, name, played[name])
            print(*figure.rows[-1], sep=" | ", flush=True)
    return kept


def add_row(figure: Figure, name: str, minutes: list[dict[str, Any]]) -> bool:
    """Add the row of a case; return whether the filter, if it is on, kept all limits."""
    position, speed, torque = (
        max(minute[key] for minute in minutes) for key in ("position", "speed", "torque")
    )
    times = {
        goals: np.array([each for minute in minutes for each in minute["times"][goals]])
        for goals in NEAR
    }
    postures, poses = np.isfinite(times["posture"]), np.isfinite(times["pose"])
    median = float(np.nanmedian(times["posture"][:, 0]))
    outcomes: Counter[str] = sum((Counter(minute["outcomes"]) for minute in minutes), Counter())
    fine = position == 0.0 and speed == 0.0 and torque <= 1.0 + 1e-9
    filtered = CASES[name].filtered
    share = 1.0 - outcomes["as wanted"] / max(outcomes.total(), 1)
    figure.metrics |= {
        f"{name}: position": position,
        f"{name}: speed": speed,
        f"{name}: postures": len(postures),
        f"{name}: near": float(postures[:, 0].mean()),
        f"{name}: at": float(postures[:, 1].mean()),
        f"{name}: poses near": float(poses[:, 0].mean()),
        f"{name}: poses at": float(poses[:, 1].mean()),
        f"{name}: time": median,
    }
    figure.rows.append(
        (
            name,
            f"{sum(minute['seconds'] for minute in minutes) / 60.0:.0f} min",
            f"{position:.2g}",
            f"{speed:.2g}",
            f"{torque:.3f}",
            f"{share:.2%}" if filtered else "-",
            verdict(fine, "kept") if filtered else "",
        )
    )
    return fine or not filtered


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
    kept = PlanLimits(limits.q_min, limits.q_max, np.full(n, 1e-6), braking, loop.dt)
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
            plans = torques.evaluate(q, v, braking_periods(q, v, times, *kept), zero)
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
    kept = compare(figure, given.minutes, given.limit, given.row)
    heads = ("arm", "played", "position, rad", "speed, rad/s", "torque")
    rows = table([figure], (*heads, "steps changed", ""))
    print("\n" + rows)
    if given.row:
        return 0 if kept else 1
    write_part("whole-arm", rows)
    picture, axes = plt.subplots(1, 3, figsize=(12.5, 4.0), layout="constrained")
    shoulder(axes[0])
    safe_set(axes[1], 0.0)
    safe_set(axes[2], 1.5)
    picture.savefig(ROOT / "docs" / "images" / "whole_arm.png", dpi=90)
    figure.save(picture)
    return 0 if kept else 1


if __name__ == "__main__":
    raise SystemExit(main())
