# SPDX-License-Identifier: Apache-2.0
"""The picture of README: one goal, with usual bounds through a limit, with exact ones up to it."""

from __future__ import annotations

from contextlib import closing
from io import BytesIO

import matplotlib.pyplot as plt
import numpy as np
from camera import Camera
from chain import ROOT
from direct import DirectLoop, column
from PIL import Image

JOINT = 3  # the elbow, panda_joint4
GOAL = np.array([0.0, 0.35, 0.0, 0.3, 0.0, 1.9, 0.8])  # rad, the elbow's beyond its limit
GAINS = {"posture_kp": 100.0, "posture_kd": 20.0}
BEGIN, DURATION, BETWEEN = 1.0, 2.1, 0.03  # s; shown from the first on
EYE, TARGET, SIZE, ANGLE = (1.6, -1.9, 0.8), (0.18, 0.0, 0.52), (430, 330), 29.0
RED, BLUE = "#c62828", "#1565c0"
METHODS = {"usual bounds": "naive", "exact bounds": "exact"}


def play(method: str) -> tuple[DirectLoop, np.ndarray, np.ndarray]:
    """Return the loop after a run to the goal, times and positions of all joints."""
    loop = DirectLoop("panda", {"method": method} | GAINS)
    loop.controller.goals.release_pose()
    loop.controller.goals.set_posture(GOAL)
    samples = loop.run(DURATION)
    return loop, column(samples, "t"), column(samples, "q")


def main() -> None:
    """Draw the frames, and write them as one moving picture."""
    runs = {title: play(method) for title, method in METHODS.items()}
    loop, t, _ = next(iter(runs.values()))
    limit = loop.config.position_max[JOINT]
    every = round(BETWEEN / loop.dt)
    for title, (_, _, q) in runs.items():
        print(f"{title}: elbow {np.degrees(q[:, JOINT].max() - limit):+.2f}° past its limit")
    with closing(Camera(loop.robot, 0.0)) as camera:
        frames = [
            _frame(camera, runs, limit, k)
            for k in [*range(round(BEGIN / loop.dt), len(t), every), len(t) - 1]
        ]
    # Who shows only the first frame shows the end.
    frames = [frames[-1], *frames]
    times = [1500, *[round(3000 * BETWEEN)] * (len(frames) - 2), 1500]  # ms; a third as fast
    palette = frames[0].quantize(96, Image.Quantize.MAXCOVERAGE)
    first, *others = [frame.quantize(palette=palette, dither=0) for frame in frames]
    first.save(
        ROOT / "docs" / "images" / "contrast.gif",
        save_all=True,
        append_images=others,
        duration=times,
        loop=0,
        optimize=True,
    )


def _frame(
    camera: Camera,
    runs: dict[str, tuple[DirectLoop, np.ndarray, np.ndarray]],
    limit: float,
    k: int,
) -> Image.Image:
    """Return both arms at step `k`, above the way of their elbows up to there."""
    picture, axes = plt.subplots(
        2, 2, figsize=(8.8, 5.2), height_ratios=(3.0, 2.0), sharey="row", layout="constrained"
    )
    for (title, (_, t, q)), (view, axis) in zip(runs.items(), axes.T, strict=True):
        elbow = np.degrees(q[: k + 1, JOINT] - limit)
        worst, color = elbow.max(), RED if elbow.max() > 0.0 else BLUE
        view.imshow(camera.snapshot(EYE, TARGET, SIZE, q=q[k], angle=ANGLE))
        view.set_xticks([], [])
        view.set_yticks([], [])
        for side in view.spines.values():
            side.set(color=color, linewidth=3)
        told = f"{worst:.1f}° through the limit" if worst > 0.0 else "inside the limit"
        view.set_title(f"{title}: {told}", color=color, fontweight="bold")
        axis.axhspan(0.0, 90.0, color=RED, alpha=0.15, linewidth=0.0)
        axis.axhline(0.0, color=RED, linewidth=1.5)
        axis.plot(t[: k + 1], elbow, color=color, linewidth=2)
        axis.set(xlim=(BEGIN, DURATION), ylim=(-30.0, 10.0), xlabel="time [s]")
        axis.grid(alpha=0.3)
        axis.text(BEGIN + 0.03, 6.0, "beyond the limit", color=RED, fontsize="small")
    axes[1, 0].set_ylabel("elbow to its limit [°]")
    drawn = BytesIO()
    picture.savefig(drawn, dpi=100)
    plt.close(picture)
    return Image.open(drawn).convert("RGB")


if __name__ == "__main__":
    main()
