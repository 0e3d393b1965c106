# SPDX-License-Identifier: Apache-2.0
"""Goals out of reach: how still the arms become, without and with a largest speed of approach.

bash scripts/reproduce.sh out_of_reach

The hand is sent 1 m from where it begins, out of reach for all but one of these goals, with
exact states; the last second of `SECONDS` counts. The page is `docs/out_of_reach.md`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin
from direct import DirectLoop, column, distance
from figure import Figure, table

ROBOTS = ("panda", "talos_left_arm", "baxter_left_arm")
AXES = {
    f"{sign}{axis}": (number, k)
    for sign, number in (("+", 1.0), ("-", -1.0))
    for k, axis in enumerate("xyz")
}
SECONDS = 15.0
SPEED = {"panda": [0.5, 1.5], "talos_left_arm": [0.5, 1.5], "baxter_left_arm": [0.2, 0.6]}
"""`pose_speed_max`, m/s and rad/s."""


def settle(robot: str, offset: np.ndarray, changed: dict[str, Any]) -> tuple[float, float, float]:
    """Return torque step, of torque_max, speed, rad/s, and distance, m, in the last second."""
    loop = DirectLoop(robot, changed)
    loop.controller.set_pose_goal(loop.pose() * pin.SE3(np.eye(3), offset))
    last = loop.run(SECONDS)[-round(1.0 / loop.dt) :]
    steps = np.abs(np.diff(column(last, "tau"), axis=0)) / loop.config.torque_max
    return float(steps.max()), float(np.abs(column(last, "v")).max()), float(distance(last)[-1])


def main() -> int:
    """Play all, print the table; return whether no arm steps by more than 5% of its torque."""
    figure = Figure("out_of_reach")
    for robot in ROBOTS:
        for axis, (sign, k) in AXES.items():
            offset = np.zeros(3)
            offset[k] = sign
            before = settle(robot, offset, {})
            after = settle(robot, offset, {"pose_speed_max": SPEED[robot]})
            figure.metrics[f"{robot}{axis}"] = after
            figure.rows.append(
                (
                    f"{robot}, {axis}",
                    *(f"{step:.2%}, {speed:.3f} rad/s" for step, speed, _ in (before, after)),
                    f"{before[2]:.3f}, {after[2]:.3f} m",
                )
            )
            print(*figure.rows[-1], sep=" | ", flush=True)
    print("\n" + table([figure], ("hand sent by 1 m", "as in its file", "with the speed", "left")))
    figure.save(None)
    return int(max(step for step, _, _ in figure.metrics.values()) > 0.05)


if __name__ == "__main__":
    raise SystemExit(main())
