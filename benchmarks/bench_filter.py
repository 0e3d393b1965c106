# SPDX-License-Identifier: Apache-2.0
"""The safety filter's share of a control step, against the number of joints.

Filters of several arms look and choose in turns, in random states, a safe plan being in hand as in
each step but the first. What is wanted are random corners of the bounds, so that some steps are
changed. Two arms are one model, as if one controller had both. Times are of the processor,
whatever else it does.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from viability_bounds_pkg.robot_description import build_model, read_urdf
from viability_bounds_pkg.whole_arm.safety_filter import SafetyFilter

ROOT = Path(__file__).resolve().parent.parent
ARMS = ("panda", "baxter_left_arm", "talos_left_arm")


def values_of(robot: str) -> dict[str, Any]:
    """Return the parameters of a robot's file."""
    content = yaml.safe_load((ROOT / "config" / f"{robot}.yaml").read_text())
    return {k: v for part in content.values() for k, v in part["ros__parameters"].items()}


class Timed:
    """A filter, random states of its arm, and what its steps took.

    Args:
        robot: its file.
        mirror: what to replace in names of joints, and by what, for a second arm; None for none.
        most: joints of the file that are used.
    """

    def __init__(self, robot: str, mirror: tuple[str, str] | None = None, most: int = 99) -> None:
        given = values_of(robot)
        joints, repeat = given["joints"][:most], 1
        if mirror is not None:
            joints, repeat = joints + [name.replace(*mirror) for name in joints], 2

        def array(key: str) -> np.ndarray:
            return np.tile(np.array(given[key], dtype=float)[:most], repeat)

        self.model = build_model(read_urdf(given["robot_description"]), joints)
        if "rotor_inertia" in given:
            self.model.armature = array("rotor_inertia")
        self.low, self.high = self.model.lowerPositionLimit, self.model.upperPositionLimit
        self.v_max, self.a_min, self.a_max = (
            array(key) for key in ("velocity_max", "acceleration_min", "acceleration_max")
        )
        self.n, self.dt = len(joints), 1.0 / given["rate_hz"]
        self.filter = SafetyFilter(
            self.model,
            self.low,
            self.high,
            self.a_min,
            self.a_max,
            array("torque_max"),
            self.dt,
        )
        self.times: list[float] = []
        self._rng = np.random.default_rng(0)

    def find_state(self) -> None:
        """Find the next random state that a safe plan is known from, and take that in hand."""
        rng, keeper, zero, free = self._rng, self.filter, np.zeros(self.n), np.full(self.n, np.inf)
        while True:
            q = rng.uniform(self.low, self.high)
            v = 0.5 * rng.uniform(-self.v_max, self.v_max)
            keeper.reset()
            keeper.look(q, v, zero, -free, free)
            if keeper.slack >= 0.0:
                break
        self._state = q, v, np.where(rng.random(self.n) < 0.5, self.a_min, self.a_max)

    def step(self) -> None:
        """Time a step in it."""
        q, v, a = self._state
        zero, keeper = np.zeros(self.n), self.filter
        begin = time.thread_time()
        keeper.look(q, v, zero, self.a_min, self.a_max)
        keeper.choose(a)
        self.times.append(1e6 * (time.thread_time() - begin))


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=2000)
    options = parser.parse_args()
    filters = {
        "Panda, its first 4 joints": Timed("panda", most=4),
        "Panda": Timed("panda"),
        "Baxter, left arm": Timed("baxter_left_arm"),
        "TALOS, torso and arm": Timed("talos_left_arm"),
        "Baxter, both arms": Timed("baxter_left_arm", ("left_", "right_")),
    }
    for _ in range(options.steps):
        for each in filters.values():
            each.find_state()
        for each in filters.values():  # by now caches hold other things, as in a control loop
            each.step()
    print(f"{'look and choose':<28} joints  median     99%   of the period   as wanted")
    sizes, medians = [], []
    for name, each in filters.items():
        median, slow = np.percentile(each.times, (50, 99))
        sizes.append(each.n)
        medians.append(median)
        outcomes = each.filter.outcomes
        wanted = outcomes["as wanted"] / max(outcomes.total(), 1)
        print(
            f"{name:<28}{each.n:6d}{median:6.0f} us{slow:5.0f} us{1e-4 * slow / each.dt:12.1f} %"
            f"{100.0 * wanted:12.0f} %"
        )
    growth = np.polyfit(np.log(sizes), np.log(medians), 1)[0]
    print(f"medians grow with the {growth:.2f}th power of the number of joints")


if __name__ == "__main__":
    main()
