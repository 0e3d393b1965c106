# SPDX-License-Identifier: Apache-2.0
"""Robot, bounds and controller by the wall clock: one process, separate ones, a bare loop.

Each robot plays its demo's goals by turns in the ways to run it, and tells what was missed:
periods without their command in time, and those in which the simulated robot was late itself;
"both" is what a real robot would miss. A bare loop only sleeps until the next period; a busy loop
computes in each for as long as the one process; relays stand in place of bounds and controller.

With --loads, robots are sent to random corners of their position limits instead, with stiff gains,
a process for each node, while the machine is idle, or as many programs as it has processors
compute without end, or programs are stopped for 5 to 500 ms, again and again. The limits are
checked at each physics step; the exit code is 1 when one was passed. The table of all robots and
loads goes to docs/results.md.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from chain import load_values
from figure import table, write_part
from live_robot import (
    ONE_PROCESS,
    PROCESSES,
    RELAYS,
    Programs,
    User,
    configuration,
    cpu_seconds,
    disturbed,
    goals,
    load,
    running,
)

from viability_bounds_pkg.recent_values import RecentValues
from viability_bounds_pkg.testing.ros_harness import joint_state, private_domain

CASES = {
    "panda@500": ("panda", 500.0),
    "panda@1000": ("panda", 1000.0),
    "talos_left_arm@1000": ("talos_left_arm", 1000.0),
    "baxter_left_arm@100": ("baxter_left_arm", 100.0),
}
WAYS = RELAYS, ONE_PROCESS, PROCESSES
SETTLING = 1.0
"""How long a robot moves before it is measured, s."""
LOADED = "panda@500", "talos_left_arm@1000", "baxter_left_arm@100"
LOADS = (
    "idle",
    "busy",
    "pause controller_node",
    "pause bounds_node",
    "pause bullet_node",
    "pause all",
)
HASTE = {"posture_kp": 100.0, "posture_kd": -1.0, "posture_weight": 10.0, "pose_weight": 0.0}
"""Gains by which joint goals drive the joints at their limits."""
CORNERS = 40
LOAD_HEADS = (
    "robot",
    "load",
    "periods",
    "missed",
    "late",
    "stopped",
    "nearest limit, rad",
    "limits",
)


def memory(programs: Programs) -> float:
    """Return the memory of running programs, what they share counted once, MB."""
    lines = (
        Path(f"/proc/{process.pid}/smaps_rollup").read_text() for process in programs.values()
    )
    return sum(int(text.partition("\nPss:")[2].split()[0]) for text in lines) / 1024


def measure(
    robot: str, rate: float, way: str, seconds: float, imperfect: bool
) -> tuple[str, float]:
    """Run a robot for some seconds; return the row, and the share of a processor that was used."""
    arguments = configuration(robot, rate, imperfect=imperfect)
    with running(way, arguments, imperfect) as programs:
        user = User(goals(robot), "target_pose")
        try:
            user.start(programs)
            user.use(SETTLING)
            before, used, begin = user.report(), cpu_seconds(programs), time.monotonic()
            user.use(seconds)
            after = user.report()
            cpu = (cpu_seconds(programs) - used) / (time.monotonic() - begin)
            megabytes = memory(programs)
        finally:
            user.ros.close()
    counts = [
        int(after[key]) - int(before[key])
        for key in ("periods", "deadline_misses", "late_periods", "braked_periods")
    ]
    errors = [float(after[f"period_error_{part}_us"]) for part in ("p50", "p99", "max")]
    latency = [float(after[f"latency_{part}_us"]) for part in ("p50", "p99")]
    return row(way, counts, [*errors, *latency], cpu, megabytes), cpu


def bare_loop(rate: float, seconds: float, busy: float = 0.0) -> str:
    """Sleep until each period begins, and be busy for a share of it; return the row."""
    dt, errors, lost, periods = 1.0 / rate, RecentValues(), 0, 0
    begin = last = time.monotonic()
    used = time.process_time()
    due = begin + dt
    while last < begin + seconds:
        time.sleep(max(0.0, due - time.monotonic()))
        now = time.monotonic()
        errors.add(abs(now - last - dt))
        late = max(0, math.floor((now - due) / dt))
        lost += late
        periods += 1
        due += dt * (1 + late)
        last = now
        while time.monotonic() < now + busy * dt:
            pass
    cpu = (time.process_time() - used) / (last - begin)
    found = [1e6 * errors.percentile(50), 1e6 * errors.percentile(99), 1e6 * errors.largest]
    times = [*found, math.nan, math.nan]
    return row("busy loop" if busy else "bare loop", [periods, 0, lost, 0], times, cpu, math.nan)


HEAD = (
    f"{'':12} {'periods':>8} {'missed':>7} {'late':>6} {'both':>7} {'stopped':>8} "
    f"{'period error, us':^25} {'latency, us':^17} {'CPU':>6} {'memory':>7}\n"
    f"{'':52} {'p50':>7} {'p99':>8} {'max':>9} {'p50':>7} {'p99':>9} {'':>6} {'MB':>7}"
)


def row(name: str, counts: list[int], times: list[float], cpu: float, megabytes: float) -> str:
    """Return a line of the table."""
    periods, missed, late, stopped = counts
    widths = (7, 8, 9, 7, 9)
    return (
        f"{name:12} {periods:8} {missed:7} {late:6} {(missed + late) / (periods + late):7.2%} "
        f"{stopped:8} {' '.join(f'{t:{w}.0f}' for t, w in zip(times, widths, strict=True))} "
        f"{cpu:6.0%} {megabytes:7.0f}"
    ).replace("nan", "  -")


def under_load(
    robot: str, kind: str, seconds: float, seed: int, imperfect: bool
) -> tuple[str, ...]:
    """Drive a robot at its limits under a load for some seconds; return the row."""
    rng, values = np.random.default_rng(seed), load_values(robot)
    low, high = (np.array(values[f"position_{end}"]) for end in ("min", "max"))
    corners = [
        joint_state(values["joints"], 0, np.where(rng.random(len(low)) < 0.5, low, high))
        for _ in range(CORNERS)
    ]
    arguments = configuration(robot, imperfect=imperfect)
    for name, value in HASTE.items():
        arguments += ["-p", f"controller_node:{name}:={value}"]
    with private_domain() as domain:
        os.environ["ROS_DOMAIN_ID"] = str(domain)
        with running(PROCESSES, arguments, imperfect) as programs:
            user = User(corners, "target_posture")
            try:
                user.start(programs)
                with disturbed(kind, programs, rng):
                    user.use(seconds)
                found = user.report()
            finally:
                user.ros.close()
    return load_row(robot, kind, found)


def load_row(robot: str, kind: str, found: dict[str, Any]) -> tuple[str, ...]:
    """Return the row of a run by what the robot reports; the last cell names what was passed."""

    def worst(key: str, of: Any = max) -> float:
        return float(of(float(word) for word in found[key].split()))

    beyond = (
        ("position", worst("position_violation_rad"), "rad"),
        ("speed", worst("velocity_violation_rad_s"), "rad/s"),
    )
    passed = [f"{name} by {value:.2g} {unit}" for name, value, unit in beyond if value > 0.0]
    if found["level"] == b"\x02" and not passed:
        passed.append("torque")
    nearest = min(worst(f"{end}_clearance_rad", min) for end in ("lower", "upper"))
    keys = ("periods", "deadline_misses", "late_periods", "braked_periods")
    counts = (found[key] for key in keys)
    verdict = f"**passed**: {', '.join(passed)}" if passed else "kept"
    return robot, kind, *counts, f"{nearest:.1g}", verdict


def all_loads(options: argparse.Namespace) -> int:
    """Run robots under loads, print the table; return 1 if a limit was passed."""
    print(f"{options.seconds:g} s each; {load()}", *LOAD_HEADS, sep=" | ", flush=True)
    rows = []
    for case in options.case or LOADED:
        for kind in options.load or LOADS:
            robot = CASES[case][0]
            rows.append(under_load(robot, kind, options.seconds, options.seed, options.imperfect))
            print(*rows[-1], sep=" | ", flush=True)
    if not (options.case or options.load or options.imperfect):
        write_part("late-machines", table(rows, LOAD_HEADS))
    return int(any(cells[-1] != "kept" for cells in rows))


def main() -> int:
    """Measure and print; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, help="for each line (4; 60 with --loads)")
    parser.add_argument("--case", action="append", choices=CASES, help="repeatable; default: all")
    parser.add_argument("--imperfect", action="store_true", help="robots with all remedies")
    parser.add_argument("--loads", action="store_true", help="limits kept on late machines")
    parser.add_argument("--load", action="append", choices=LOADS, help="repeatable; default: all")
    parser.add_argument("--seed", type=int, default=0, help="of goals and pauses")
    options = parser.parse_args()
    options.seconds = options.seconds or (60.0 if options.loads else 4.0)
    if options.loads:
        return all_loads(options)
    for case in options.case or CASES:
        robot, rate = CASES[case]
        print(f"\n{robot} at {rate:g} Hz; {load()}\n{HEAD}")
        print(bare_loop(rate, options.seconds))
        for way in WAYS:
            line, cpu = measure(robot, rate, way, options.seconds, options.imperfect)
            print(line, flush=True)
            if way == ONE_PROCESS:
                print(bare_loop(rate, options.seconds, min(cpu, 0.95)), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
