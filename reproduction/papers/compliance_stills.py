# SPDX-License-Identifier: Apache-2.0
"""Rendered pictures of the arm, as in figures 7, 8 and 10 of [Benallegue2021]."""

from __future__ import annotations

from contextlib import closing
from typing import NamedTuple

import matplotlib.pyplot as plt
import numpy as np
import pinocchio as pin
from camera import Camera
from compliance_curve import Drawn, among_poles
from compliance_push import ELBOW, Pushed, runs
from figure import Figure

FLOOR = -1.07  # m, under the feet


class View(NamedTuple):
    """Where a camera is, where it looks, and what it sees."""

    eye: tuple[float, float, float]
    target: tuple[float, float, float]
    size: tuple[int, int] = (380, 380)  # pixels
    angle: float = 30.0  # from top to bottom, degrees

    def pixel(self, point: np.ndarray) -> np.ndarray:
        """Return where a point is in the picture, shape (2,), from the left and from above."""
        eye, target = np.array(self.eye), np.array(self.target)
        ahead = (target - eye) / np.linalg.norm(target - eye)
        right = np.cross(ahead, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        up = np.cross(right, ahead)
        x, y, depth = ((point - eye) @ axis for axis in (right, up, ahead))
        scale = 0.5 * self.size[1] / np.tan(np.radians(0.5 * self.angle)) / depth
        return 0.5 * np.array(self.size) + scale * np.array([x, -y])


PUSHED = View((1.9, 1.35, 0.75), (0.18, 0.2, 0.15))
AMONG_POLES = View((1.75, 1.5, 0.95), (0.42, 0.0, 0.32))


def _elbow(run: Pushed | Drawn, q: np.ndarray) -> np.ndarray:
    """Return where the elbow is, shape (3,), m."""
    data = run.loop.model.createData()
    pin.framesForwardKinematics(run.loop.model, data, q)
    return data.oMf[run.loop.model.getFrameId(ELBOW)].translation


def _show(axis: plt.Axes, image: np.ndarray, title: str) -> None:
    axis.imshow(image)
    axis.set_title(title, fontsize="small")
    axis.axis("off")


def figures_7_and_8() -> Figure:
    """The elbow before it is pushed, while it is, and when it was let go."""
    figure = Figure("paper1-fig7-8")
    picture, axes = plt.subplots(2, 4, figsize=(12, 6.8), layout="constrained")
    for row, (name, run) in zip(axes, runs().items(), strict=True):
        there, back = run.named("elbow")
        steps = {
            "before": run.during(there).start,
            f"elbow pushed, {np.linalg.norm(there.force):.0f} N": run.during(there).stop - 1,
            "let go": run.during(there, 0.4).stop,
            f"pushed back, {np.linalg.norm(back.force):.0f} N": run.during(back).stop - 1,
        }
        before = _elbow(run, run.samples[run.during(there).start].q)
        with closing(Camera(run.loop.robot, FLOOR)) as camera:
            for axis, (title, k), each in zip(
                row, steps.items(), (None, there, None, back), strict=True
            ):
                q = run.samples[k].q
                image = camera.snapshot(
                    PUSHED.eye, PUSHED.target, PUSHED.size, q=q, angle=PUSHED.angle
                )
                elbow = _elbow(run, q)
                way = np.linalg.norm(elbow - before)
                figure.metrics[f"{name}: {title}: elbow_m"] = float(way)
                _show(axis, image, f"{name},\n{title}: elbow {1e3 * way:.0f} mm off")
                axis.plot(*PUSHED.pixel(before), "+", color="white", ms=14, mew=2)
                if each is not None:
                    tip = PUSHED.pixel(elbow)
                    tail = PUSHED.pixel(elbow - 0.35 * each.force / np.linalg.norm(each.force))
                    arrow = {"arrowstyle": "-|>", "color": "red", "lw": 2.5}
                    axis.annotate("", tip, tail, arrowprops=arrow)
    figure.save(picture, "compliance")
    return figure


def figure_10_stills() -> Figure:
    """The moments of each turn in which the poles press hardest on the arm."""
    figure = Figure("paper1-fig10-stills")
    picture, axes = plt.subplots(2, 4, figsize=(12, 6.8), layout="constrained")
    view = AMONG_POLES
    for row, (name, run) in zip(axes, among_poles().items(), strict=True):
        moments = [0]
        for turn in range(run.turn[-1] + 1):
            inside = np.where(run.turn == turn, run.forces, -1.0)
            moments.append(int(inside.argmax()))
        path = np.array([view.pixel(place) for place in run.goals[::100]])
        with closing(Camera(run.loop.robot, FLOOR)) as camera:
            for axis, k in zip(row, moments, strict=True):
                image = camera.snapshot(
                    view.eye, view.target, view.size, q=run.samples[k].q, angle=view.angle
                )
                off = 1e3 * np.linalg.norm(run.places[k] - run.goals[k])
                told = f"poles {run.forces[k]:.0f} N, hand {off:.1f} mm off"
                _show(axis, image, f"{name},\n{run.t[k]:.1f} s: {told}")
                axis.plot(*path.T, color="red", lw=1)
                axis.plot(*view.pixel(run.goals[k]), "o", color="red", ms=5)
                axis.set(xlim=(0, view.size[0]), ylim=(view.size[1], 0))
    figure.save(picture, "poles")
    return figure
