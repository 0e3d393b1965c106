# SPDX-License-Identifier: Apache-2.0
"""Figures 10 and 11 of [Benallegue2021]: a curve among poles that the controller does not know."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any, NamedTuple

import matplotlib.pyplot as plt
import numpy as np
from compliance_push import MODES, ROBOT
from direct import (
    DirectLoop,
    Sample,
    column,
    hand_errors,
    hand_places,
    within_limits,
)
from figure import Figure

from sim_bridge.bullet.obstacles import Obstacle
from viability_bounds_pkg.pose_trajectory import PoseTrajectory, circle

# Where a circle of 0.4 m in the y-z plane stays far from all limits for several turns.
START = [-0.33, 0.22, -1.06, 1.44, 0.08, -1.43, 0.67, -0.21, 0.04]  # rad
PLANE = [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]  # from the lowest point towards y
DIAMETER, PERIOD, TURNS = 0.4, 8.0, 3  # m, s
SETTLING = 0.5  # s
_SIDE = np.sqrt(0.5)


def _pole(name: str, along: str, centre: tuple[float, float, float], length: float) -> Obstacle:
    turned = {
        "x": (0.0, _SIDE, 0.0, _SIDE),
        "y": (_SIDE, 0.0, 0.0, _SIDE),
        "z": (0.0, 0.0, 0.0, 1.0),
    }
    return Obstacle(name, "cylinder", (0.04, 0.04, length), centre, turned[along])


# One above the elbow where it rises, one below the upper arm where it comes down.
POLES = (
    _pole("upper pole", "x", (0.40, 0.36, 0.44), 0.25),
    _pole("lower pole", "y", (0.42, 0.0, 0.28), 0.2),
)
# Little room in the null space: a joint of the wrist reaches its limit.
UPRIGHT = _pole("upright pole", "z", (0.40, 0.40, 0.5), 1.2)


class Drawn(NamedTuple):
    """A curve as it was drawn."""

    samples: tuple[Sample, ...]
    goals: np.ndarray
    """Where the hand should have been, shape (N, 3), m."""
    places: np.ndarray
    """Where it was, shape (N, 3), m."""
    forces: np.ndarray
    """Sum of what the poles pressed with at each step, shape (N,), N."""
    touched: frozenset[str]
    """Links that touched a pole."""
    loop: DirectLoop

    @property
    def turn(self) -> np.ndarray:
        """In which turn the reference was at each step, from 0, shape (N,)."""
        y, z = (self.goals - self.goals[0])[:, 1:].T
        angle = np.unwrap(np.arctan2(y, 0.5 * DIAMETER - z))
        return np.minimum(angle / (2.0 * np.pi), angle[-1] / (2.0 * np.pi) - 0.5).astype(int)

    @property
    def t(self) -> np.ndarray:
        """Time from the start, shape (N,), s."""
        return column(self.samples, "t") - self.samples[0].t


def draw(
    changed: Mapping[str, Any],
    poles: Sequence[Obstacle] = (),
    turns: int = TURNS,
    period: float = PERIOD,
) -> Drawn:
    """Draw the curve with the arm.

    Args:
        changed: parameters that differ from the file's.
        poles: that stand in the way.
        turns: how often.
        period: mean duration of a turn, s.
    """
    loop = DirectLoop(ROBOT, {"start_positions": START, **changed})
    for pole in poles:
        loop.robot.obstacles.add(pole)
    loop.run(SETTLING)
    trajectory = PoseTrajectory(
        circle(loop.pose(), 0.5 * DIAMETER, PLANE, period=period, turns=turns)
    )
    begin = loop.t
    goals, forces, touched = [], [], set()

    def each(t: float) -> None:
        pose, twist, twist_rate = trajectory.sample(t - begin)
        loop.controller.goals.set_pose(pose, twist, twist_rate)
        goals.append(pose.translation)
        contacts = loop.robot.obstacles.contacts() if poles else []
        forces.append(sum(np.linalg.norm(contact.force) for contact in contacts))
        touched.update(contact.link for contact in contacts)

    samples = loop.run(trajectory.duration, each)
    return Drawn(
        samples,
        np.array(goals),
        hand_places(loop, samples),
        np.array(forces),
        frozenset(touched),
        loop,
    )


def judge(run: Drawn) -> dict[str, float]:
    """Return what a run amounts to."""
    place, turn = hand_errors(run.samples)
    touching = run.forces > 0.0
    result = {
        "hand_m": float(place.max()),
        "hand_rms_m": float(np.sqrt(np.mean(place**2))),
        "hand_rad": float(turn.max()),
        "force_n": float(run.forces.max()),
        "force_mean_n": float(run.forces[touching].mean()) if touching.any() else 0.0,
        "impulse_n_s": float(run.forces.sum() * run.loop.dt),
        "touching_s": float(touching.sum() * run.loop.dt),
        "within_limits": float(within_limits(run.loop)),
        "torque_share": float(run.loop.robot.monitor.max_torque_ratio.max()),
    }
    for k in range(run.turn[-1] + 1):
        result[f"turn_{k + 1}_hand_m"] = float(place[run.turn == k].max())
        result[f"turn_{k + 1}_force_n"] = float(run.forces[run.turn == k].max())
    return result


SPRING = {"posture_kp": 1.0}
"""1/s^2: barely felt, but brings the null space back to the poles in every turn."""


@cache
def among_poles() -> dict[str, Drawn]:
    """Return the curve among the poles without and with null-space compliance."""
    return {name: draw(changed | SPRING, POLES) for name, changed in MODES.items()}


def figure_10() -> Figure:
    """The curve, free and among poles, without and with null-space compliance."""
    figure = Figure("paper1-fig10")
    free = {name: draw(changed) for name, changed in MODES.items()}
    poles = among_poles()
    slack = {name: draw(changed, POLES) for name, changed in MODES.items()}
    found = {}
    for kind, runs in (("free", free), ("poles", poles), ("poles, kp 0", slack)):
        for name, run in runs.items():
            found[kind, name] = judge(run)
            figure.metrics |= {f"{kind}, {name}: {k}": v for k, v in found[kind, name].items()}
            figure.data |= {
                f"{kind}, {name}: {what}": value.astype(np.float32)
                for what, value in (
                    ("t", run.t),
                    ("goal", run.goals),
                    ("place", run.places),
                    ("force", run.forces),
                    ("q", column(run.samples, "q")),
                )
            }
    figure.rows += _rows(found)
    figure.save(_picture(free, poles))
    return figure


def adverse() -> Figure:
    """A pole to which the null space cannot yield."""
    figure = Figure("paper1-adverse-pole")
    found = {name: judge(draw(changed, [UPRIGHT], 2)) for name, changed in MODES.items()}
    for name, each in found.items():
        figure.metrics |= {f"{name}: {key}": value for key, value in each.items()}
    told = [
        f"{_told(each)}, {each['force_n']:.0f} N, {each['impulse_n_s']:.0f} N s"
        for each in found.values()
    ]
    kept = all(each["within_limits"] for each in found.values())
    figure.rows.append(
        (
            "An upright pole at the left, where the null space has little room, 2 turns",
            "-",
            f"without: {told[0]}; with: {told[1]}",
            "for comparison: the null space cannot yield to every pole" if kept else "DIFFERS",
        )
    )
    figure.save(None)
    return figure


def _told(found: dict[str, float]) -> str:
    limits = "no limit broken" if found["within_limits"] else "a limit BROKEN"
    return f"hand within {1e3 * found['hand_m']:.1f} mm, {limits}"


def _forces(found: dict[str, float]) -> str:
    turns = [found[f"turn_{k + 1}_force_n"] for k in range(TURNS)]
    return (
        f"{', '.join(f'{each:.0f}' for each in turns)} N in turns 1 to {TURNS}, "
        f"{found['impulse_n_s']:.0f} N s in all"
    )


def _rows(found: dict[tuple[str, str], dict[str, float]]) -> list[tuple[str, str, str, str]]:
    without, with_ = MODES
    rows = []
    both = [found["free", name] for name in MODES]
    good = all(each["hand_m"] < 0.02 and each["within_limits"] for each in both)
    rows.append(
        (
            f"Fig. 10, 11: {TURNS} turns of a circle of 40 cm in the y-z plane, without poles",
            "-",
            f"without: {_told(both[0])}; with: {_told(both[1])}",
            "under 2 cm" if good else "DIFFERS",
        )
    )
    for kind, what in (
        ("poles", "the same among two rigid poles, posture kp 1 1/s²"),
        ("poles, kp 0", "the same, posture kp 0: the arm stays where the poles have put it"),
    ):
        with_it, lacking = found[kind, with_], found[kind, without]
        kept = with_it["hand_m"] < 0.02 and with_it["within_limits"]
        lower = with_it["force_n"] < lacking["force_n"]
        lower &= with_it["impulse_n_s"] < lacking["impulse_n_s"]
        rows.append(
            (
                f"Fig. 10, 11: {what}",
                "under 2 cm; only tried with",
                f"with: {_told(with_it)}, {_forces(with_it)}; without: {_told(lacking)}, "
                f"{_forces(lacking)}",
                "so with the file's values" if kept and lower else "DIFFERS",
            )
        )
    return rows


def _picture(free: Mapping[str, Drawn], poles: Mapping[str, Drawn]) -> plt.Figure:
    picture, axes = plt.subplots(4, 2, figsize=(13, 12), layout="constrained")
    for column_of, name in zip(axes.T, MODES, strict=True):
        runs = {"free": (free[name], "tab:green"), "among poles": (poles[name], "tab:red")}
        plane, path, error, force = column_of
        goals = free[name].goals
        plane.plot(goals[:, 1], goals[:, 2], "k--", label="reference")
        for k, label in ((1, "y"), (2, "z")):
            path.plot(free[name].t, goals[:, k], "k--", label="reference" if k == 1 else None)
            color = "tab:blue" if k == 1 else "tab:orange"
            run = poles[name]
            path.plot(run.t, run.places[:, k], color=color, label=f"{label}, among poles")
        for kind, (run, color) in runs.items():
            plane.plot(run.places[:, 1], run.places[:, 2], color=color, label=kind, lw=1)
            off_goal = 1e3 * np.linalg.norm(run.places - run.goals, axis=1)
            error.semilogy(run.t, np.maximum(off_goal, 1e-2), color=color, label=kind, lw=1)
        error.axhline(20.0, color="black", linestyle=":", label="2 cm")
        force.plot(poles[name].t, poles[name].forces, color="tab:red", lw=1)
        for axis in (path, error, force):
            for k in np.flatnonzero(np.diff(free[name].turn)):
                axis.axvline(free[name].t[k], color="gray", linestyle="--", lw=1)
        plane.set(xlabel="y [m]", ylabel="z [m]", title=name, aspect="equal")
        path.set(xlabel="time [s]; dashed: turns", ylabel="hand, y and z [m]")
        error.set(xlabel="time [s]", ylabel="hand off its reference [mm]", ylim=(1e-2, 300.0))
        top = max(run.forces.max() for run in poles.values())
        force.set(xlabel="time [s]", ylabel="poles press with [N]", ylim=(0.0, 1.05 * top))
        for axis in column_of[:3]:
            axis.legend(loc="upper right", fontsize="small")
        for axis in column_of[1:]:
            axis.grid(alpha=0.3)
    return picture
