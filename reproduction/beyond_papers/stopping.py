# SPDX-License-Identifier: Apache-2.0
"""Commands fail: the drives' own stop beside the brakes, what they violate and what a call costs.

bash scripts/reproduce.sh stopping

The robots of the parameter files, friction and wrong masses included, at physics rate: from the
edge of the kernel that the bounds keep, from random moments of fast motions under control, and
under pushes.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from contextlib import closing

import numpy as np
from chain import ROOT
from direct import DirectLoop

from sim_bridge.nodes.bullet_parameters import make_stop
from viability_bounds_pkg.node.bounds_parameters import BoundsConfiguration
from viability_bounds_pkg.stopping import CoordinatedStop
from viability_bounds_pkg.torque_margin import tightened
from viability_bounds_pkg.viability import viable_velocity_range

ROBOTS = ("panda", "talos_left_arm", "baxter_left_arm")
STATES = 200
PUSHES = {"panda": "panda_hand", "talos_left_arm": "wrist_left_ft_tool_link"}
FORCES = (10.0, 30.0, 60.0)  # N
HASTE = {"posture_kp": 100.0, "posture_kd": -1.0, "posture_weight": 10.0, "pose_weight": 0.0}
SETTLE = 0.05  # s beyond the time predicted
Row = dict[str, str | float | int]


class Arm(DirectLoop):
    """A robot under control, to which anything may happen."""

    def __init__(self, robot: str) -> None:
        super().__init__(robot, HASTE)
        self.name = robot
        self.law = make_stop(self.config)
        bounds = self._configuration("bounds_node", BoundsConfiguration)
        self.kernel = tightened(bounds.limits, bounds.margins)
        self.margin = bounds.margins.acceleration

    def edge(self, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Return a state that the bounds may lead to, most joints as fast as they may be."""
        low, high, n = self.kernel.q_min, self.kernel.q_max, len(self.kernel)
        near = rng.uniform(0.0, 0.1, n)
        places = [rng.uniform(low, high), low + near, high - near]
        q = np.clip(np.choose(rng.choice(3, n, p=[0.6, 0.2, 0.2]), places), low, high)
        slowest, fastest = viable_velocity_range(q, self.kernel, self.margin)
        share = np.where(rng.random(n) < 0.7, 1.0, rng.random(n))
        return q, share * np.where(rng.random(n) < 0.5, slowest, fastest)

    def end(
        self, q: np.ndarray, v: np.ndarray, brake: bool, push: float, seed: int
    ) -> list[float]:
        """Stop or brake; return violations of position and speed, and how late rest came."""
        robot, tau_max = self.robot, self.config.torque_max
        robot.reset(q, v)
        robot.monitor.reset()
        rng = np.random.default_rng(seed)
        direction = rng.normal(size=3)
        force = push * direction / np.linalg.norm(direction)
        begin, predicted = rng.integers(100), self.law.time_to_rest(v)
        late = np.inf
        for k in range(round((predicted + SETTLE + (push > 0.0)) / robot.physics_dt)):
            if push and k == begin:
                robot.apply_wrench(PUSHES[self.name], force, np.zeros(3))
            if push and k == begin + 100:
                robot.clear_wrenches()
            if brake:
                robot.brake(1, tau_max)
                at_rest = np.abs(robot.state().v).max() < 1e-3
            else:
                robot.stop(self.law, 1)
                at_rest = self.law.at_rest
            if at_rest:
                late = min(late, (k + 1) * robot.physics_dt - predicted)
        robot.clear_wrenches()
        monitor = robot.monitor
        violations = monitor.max_position_violation, monitor.max_velocity_violation
        assert monitor.max_torque_ratio.max() <= 1.0 + 1e-9
        return [float(each.max()) for each in violations] + [late]

    def moments(self, count: int) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return states at random moments of fast motions."""
        rng, states = np.random.default_rng(2), []
        low, high = self.config.position_min, self.config.position_max
        for _ in range(count):
            goal = np.where(rng.random(len(low)) < 0.5, low, high)
            self.controller.set_posture_goal(goal)
            self.run(rng.uniform(0.15, 0.5))
            states.append(self.robot.state()[:2])
        return states


def compare(
    arm: Arm, what: str, states: list[tuple[np.ndarray, np.ndarray]], push: float = 0.0
) -> list[Row]:
    """Return a row for the brakes and one for the stop."""
    rows: list[Row] = []
    for brake in (True, False):
        found = np.array([arm.end(*state, brake, push, i) for i, state in enumerate(states)])
        position, speed, late = found.T
        came = late[np.isfinite(late)]
        rows.append(
            {
                "robot": arm.name,
                "from": what,
                "by": "brakes" if brake else "stop",
                "states": len(states),
                "passed": int(((position > 0.0) | (speed > 0.0)).sum()),
                "position_rad": float(position.max()),
                "speed_rad_s": float(speed.max()),
                "late_ms": 1e3 * float(came.max()) if came.size else np.inf,
                "not_at_rest": int(np.isinf(late).sum()),
            }
        )
    return rows


def cost(arm: Arm) -> dict[str, float]:
    """Return the median time of a call along stops, us: plain, observing, with weak motors."""
    law, config = arm.law, arm.config
    model, limits = law._model, law._limits

    def made(share: float, observer: float) -> CoordinatedStop:
        return CoordinatedStop(
            model, limits, share * config.torque_max, law._dt, observer_time=observer
        )

    rng = np.random.default_rng(3)
    states = [arm.edge(rng) for _ in range(20)]
    result = {}
    for name, share, observer in (("plain", 1.0, np.inf), ("observer", 1.0, 0.002)):
        result[name] = _median(arm, made(share, observer), states, lambda _: True)
    weak = made(0.3, np.inf)
    result["weak"] = _median(
        arm, weak, states, lambda tau: bool((np.abs(tau) >= weak._tau_max).any())
    )
    return result


def _median(
    arm: Arm,
    law: CoordinatedStop,
    states: list[tuple[np.ndarray, np.ndarray]],
    counts: Callable[[np.ndarray], bool],
) -> float:
    times = []
    for start in states:
        q, v = start
        law.begin(q, v)
        for _ in range(200):
            before = time.perf_counter()
            tau = law.torque(q, v)
            spent = time.perf_counter() - before
            if counts(tau):
                times.append(spent)
            a = law.acceleration
            q, v = q + law._dt * v + 0.5 * law._dt**2 * a, v + law._dt * a
    return 1e6 * float(np.median(times))


def main() -> int:
    """Compare, print, and tell whether Panda's and TALOS' stops passed no limit without pushes."""
    rows: list[Row] = []
    costs = {}
    for name in ROBOTS:
        arm = Arm(name)
        with closing(arm.robot):
            rng = np.random.default_rng(1)
            edges = [arm.edge(rng) for _ in range(STATES)]
            rows += compare(arm, "edge", edges)
            rows += compare(arm, "in motion", arm.moments(STATES // 2))
            for force in FORCES if name in PUSHES else ():
                rows += compare(arm, f"edge, {force:g} N", edges[:30], force)
            costs[name] = cost(arm)
    heads = list(rows[0])
    print("| " + " | ".join(heads) + " |\n" + "|---" * len(heads) + "|")
    for row in rows:
        print(
            "| "
            + " | ".join(f"{x:.2g}" if isinstance(x, float) else str(x) for x in row.values())
            + " |"
        )
    print("\n| a call, us | plain | observer | weak motors |\n|---|---|---|---|")
    for name, each in costs.items():
        print(f"| {name} | " + " | ".join(f"{x:.0f}" for x in each.values()) + " |")
    directory = ROOT / "results" / "stopping"
    directory.mkdir(parents=True, exist_ok=True)
    (directory / "metrics.json").write_text(
        json.dumps({"rows": rows, "us": costs}, indent=2) + "\n"
    )
    promised = [
        r for r in rows if r["by"] == "stop" and r["robot"] in PUSHES and "N" not in r["from"]
    ]
    return 1 if any(row["passed"] for row in promised) else 0


if __name__ == "__main__":
    sys.exit(main())
