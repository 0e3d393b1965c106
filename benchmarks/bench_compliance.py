# SPDX-License-Identifier: Apache-2.0
"""A controller step with all that compliance adds, on TALOS' torso and arm of 9 joints.

Each arm is simulated and controlled step by step, in turns, so that caches are as cold as in a
control loop; the time is that of the controller's step alone. Every one has pose and posture
tasks, joint and torque limits, and the bounds of the parameter file.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "reproduction"))

from direct import DirectLoop  # noqa: E402

FORCES = {
    "ft_frame": "wrist_left_ft_link",
    "ft_tool": (0.0, 0.0, 0.0, 0.0),
    "contacts": (
        "{frame: wrist_left_ft_tool_link, point: [0, 0, -0.18], normal: [0, 0, 1], friction: 0.5}",
    ),
    "force_directions": np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0]),
}
PUSH = np.array([3.0, -2.0, 8.0, 0.1, 0.1, 0.1])


class Timed:
    """One arm, and what its controller's steps took."""

    def __init__(self, changed: dict, target: bool, felt: np.ndarray | None) -> None:
        self.loop = DirectLoop("talos_left_arm", changed)
        self._felt = felt
        self.times: list[float] = []
        controller = self.loop.controller
        self._random = np.random.default_rng(0)
        if target:
            controller.interaction.set_target(np.array([0.0, 0.0, -10.0, 0.0, 0.0, 0.0]))
        step = controller.step

        def timed(*arguments):
            begin = time.perf_counter()
            result = step(*arguments)
            self.times.append(time.perf_counter() - begin)
            return result

        controller.step = timed

    def step(self) -> None:
        """Play one control step."""
        if self._felt is not None:
            noise = 0.1 * self._random.normal(size=6)
            self.loop.controller.interaction.sensor.receive(self._felt + noise)
        self.loop.step()


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=3000)
    options = parser.parse_args()
    arms = {
        "pose, posture, limits": Timed({"integral_action": "none"}, False, None),
        "and integral action, all joints": Timed({"integral_action": "joints"}, False, None),
        "or stiff in the task only": Timed({"integral_action": "task"}, False, None),
        "and friction compensated": Timed(
            {"integral_action": "task", "friction_compensation": 1.0}, False, None
        ),
        "yielding to a pull": Timed(
            FORCES | {"integral_action": "task", "yield_threshold": [10.0, 2.0]},
            False,
            5.0 * PUSH,
        ),
        "pressing: admittance and a contact's force": Timed(
            FORCES | {"integral_action": "task"}, True, PUSH
        ),
        "the same with collision avoidance": Timed(
            FORCES | {"integral_action": "task", "collision_avoidance": True}, True, PUSH
        ),
    }
    for _ in range(options.steps):
        for arm in arms.values():
            arm.step()
    first = None
    print(f"{'a controller step, 9 joints':<46}  median     99%   ratio")
    for name, arm in arms.items():
        median, slow = np.percentile(arm.times[10:], (50, 99)) * 1e6
        first = first or median
        print(f"{name:<46}{median:5.0f} us{slow:5.0f} us{median / first:8.2f}")


if __name__ == "__main__":
    main()
