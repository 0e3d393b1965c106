# SPDX-License-Identifier: Apache-2.0
"""Figures 10 and 11 of [Benallegue2021]: a curve among poles that the controller does not know."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any, NamedTuple

import matplotlib.pyplot as plt
import numpy as np
from compliance_push import HEADS, MODES, PART, ROBOT, WITH_FILE
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
    turned = {"x": (0.0, _SIDE, 0.0, _SIDE), "y": (_SIDE, 0.0, 0.0, _SIDE)}
    return Obstacle(name, "cylinder", (0.04, 0.04, length), centre, turned[along])


# One above the elbow where it rises, one below the upper arm where it comes down.
POLES = (
    _pole("upper pole", "x", (0.40, 0.36, 0.44), 0.25),
    _pole("lower pole", "y", (0.42, 0.0, 0.28), 0.2),
)


class Drawn(NamedTuple):
    """A curve as it was drawn.

    Attributes:
        samples: of the loop.
        goals, places: where the hand should have been, and where it was, shape (N, 3), m.
        forces: sum of what the poles pressed with at each step, shape (N,), N.
        touched: links that touched a pole.
        loop: that was played.
    """

    samples: tuple[Sample, ...]
    goals: np.ndarray
    places: np.ndarray
    forces: np.ndarray
    touched: frozenset[str]
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
    return {
        "hand_m": float(place.max()),
        "hand_rad": float(turn.max()),
        "force_n": float(run.forces.max()),
        "impulse_n_s": float(run.forces.sum() * run.loop.dt),
        "within_limits": float(within_limits(run.loop)),
    }


SPRING = {"posture_kp": 1.0}
"""1/s^2: barely felt, but brings the null space back to the poles in every turn."""


@cache
def among_poles() -> dict[str, Drawn]:
    """Return the curve among the poles without and with null-space compliance."""
    return {name: draw(changed | SPRING, POLES) for name, changed in MODES.items()}


def figure_10() -> Figure:
    """The curve, free and among poles, without and with null-space compliance."""
    figure = Figure("paper1-fig10", PART, HEADS)
    free = {name: draw(changed) for name, changed in MODES.items()}
    poles = "the same among two rigid poles, posture kp 1 1/s²"
    turns = f"{TURNS} turns of a circle of 40 cm in the y-z plane, without poles"
    for what, paper, runs in (
        (turns, "-", free),
        (poles, "under 2 cm; only tried with", among_poles()),
    ):
        without, with_it = (judge(run) for run in runs.values())
        good = with_it["hand_m"] < 0.02 and bool(with_it["within_limits"])
        if runs is free:
            good &= without["hand_m"] < 0.02 and bool(without["within_limits"])
        else:
            good &= all(with_it[key] < without[key] for key in ("force_n", "impulse_n_s"))
        figure.add(
            f"Fig. 10, 11: {what}",
            paper,
            _told(without),
            _told(with_it),
            holds=good,
            so="under 2 cm" if runs is free else WITH_FILE,
        )
        for name, run in runs.items():
            figure.metrics |= {f"{what}, {name}: {k}": v for k, v in judge(run).items()}
            figure.data |= {
                f"{what}, {name}: {key}": value.astype(np.float32)
                for key, value in (("t", run.t), ("place", run.places), ("force", run.forces))
            }
    figure.save(_picture(free, among_poles()))
    return figure


def _told(found: dict[str, float]) -> str:
    """Return what a run amounts to, in words."""
    limits = "" if found["within_limits"] else ", a limit BROKEN"
    touching = f"; {found['force_n']:.0f} N, {found['impulse_n_s']:.0f} N s in all"
    return f"hand {1e3 * found['hand_m']:.1f} mm{limits}" + touching * (found["force_n"] > 0.0)


def _picture(free: Mapping[str, Drawn], poles: Mapping[str, Drawn]) -> plt.Figure:
    """Draw the way of the hand in the plane, its error, and the force of the poles."""
    picture, axes = plt.subplots(3, 2, figsize=(13, 10), layout="constrained")
    for (plane, error, force), name in zip(axes.T, MODES, strict=True):
        plane.plot(*free[name].goals[:, 1:].T, "k--", label="reference")
        for label, run in (("free", free[name]), ("among poles", poles[name])):
            off_goal = 1e3 * np.linalg.norm(run.places - run.goals, axis=1)
            plane.plot(*run.places[:, 1:].T, label=label, lw=1)
            error.semilogy(run.t, np.maximum(off_goal, 1e-2), label=label, lw=1)
            force.plot(run.t, run.forces, label=label, lw=1)
        error.axhline(20.0, color="black", linestyle=":", label="2 cm")
        plane.set(xlabel="y [m]", ylabel="z [m]", title=name, aspect="equal")
        error.set(xlabel="time [s]", ylabel="hand off its reference [mm]", ylim=(1e-2, 300.0))
        force.set(xlabel="time [s]", ylabel="poles press with [N]")
        for axis in (plane, error, force):
            axis.legend(loc="upper right", fontsize="small")
            axis.grid(alpha=0.3)
    return picture
