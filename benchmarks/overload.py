# SPDX-License-Identifier: Apache-2.0
"""Robots driven at their limits in real time on a machine that is kept from doing its work.

Joint goals are random corners of the position limits, one a second, with stiff gains. Meanwhile
the machine is idle, or as many processes as it has processors compute without end, or programs are
paused (SIGSTOP) for 5 to 500 ms, again and again. The simulated robot checks its limits at each
physics step. Exits with 0 when none was passed, 1 when one was.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from live_robot import (
    ONE_PROCESS,
    PROCESSES,
    ROOT,
    SEPARATE_ROBOT,
    WAYS,
    Programs,
    User,
    configuration,
    load,
    running,
)
from sensor_msgs.msg import JointState

from viability_bounds_pkg.testing.executables import as_child
from viability_bounds_pkg.testing.ros_harness import joint_state, private_domain, read_config

ROBOTS = ("panda", "talos_left_arm", "baxter_left_arm")
HASTE = {"posture_kp": 100.0, "posture_kd": -1.0, "posture_weight": 10.0, "pose_weight": 0.0}
"""Gains by which joint goals drive the joints at their limits."""

EVERYBODY = "all"
LOADS = {
    ONE_PROCESS: ("idle", "busy", f"pause {EVERYBODY}"),
    SEPARATE_ROBOT: ("idle", "busy", "pause safety_stack", f"pause {EVERYBODY}"),
    PROCESSES: (
        "idle",
        "busy",
        "pause controller_node",
        "pause bounds_node",
        "pause bullet_node",
        f"pause {EVERYBODY}",
    ),
}
"""What is done to the programs of each way to run them."""

PAUSES = 0.005, 0.5
"""Shortest and longest pause, s."""

BETWEEN = 0.05, 0.8
"""Shortest and longest time between two, s."""

GOALS = 40


def corners(robot: str, rng: np.random.Generator) -> list[JointState]:
    """Return goals in random corners of a robot's position limits."""
    values = read_config(robot)
    low, high = np.array(values["position_min"]), np.array(values["position_max"])
    return [
        joint_state(values["joints"], 0, np.where(rng.random(len(low)) < 0.5, low, high))
        for _ in range(GOALS)
    ]


@contextmanager
def busy() -> Iterator[None]:
    """Compute without end, in a process for each processor."""
    loops = [
        subprocess.Popen([sys.executable, "-c", "while True: pass"], preexec_fn=as_child)
        for _ in range(os.cpu_count() or 1)
    ]
    try:
        yield
    finally:
        for loop in loops:
            loop.kill()
            loop.wait()


@contextmanager
def pauses(programs: list[subprocess.Popen[bytes]], rng: np.random.Generator) -> Iterator[None]:
    """Pause programs together at random times."""
    ended = threading.Event()

    def disturb() -> None:
        while not ended.wait(rng.uniform(*BETWEEN)):
            for program in programs:
                program.send_signal(signal.SIGSTOP)
            ended.wait(rng.uniform(*PAUSES))
            for program in programs:
                program.send_signal(signal.SIGCONT)

    thread = threading.Thread(target=disturb)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def disturbed(load_kind: str, programs: Programs, rng: np.random.Generator) -> Any:
    """Return the context in which programs run under a load."""
    if load_kind == "busy":
        return busy()
    if load_kind.startswith("pause "):
        name = load_kind.removeprefix("pause ")
        every = name == EVERYBODY
        return pauses([each for key, each in programs.items() if every or key == name], rng)
    return ExitStack()


def measure(robot: str, way: str, kind: str, seconds: float, options: Any) -> dict[str, Any]:
    """Run a robot under a load for some seconds; return what came of it."""
    rng = np.random.default_rng(options.seed)
    arguments = configuration(robot, imperfect=options.imperfect)
    for name, value in HASTE.items():
        arguments += ["-p", f"controller_node:{name}:={value}"]
    with private_domain() as domain:
        os.environ["ROS_DOMAIN_ID"] = str(domain)
        with running(way, arguments, options.imperfect) as programs:
            user = User(corners(robot, rng), "target_posture")
            try:
                user.start(programs)
                with disturbed(kind, programs, rng):
                    user.use(seconds)
                found = user.report()
            finally:
                user.ros.close()

    def numbers(key: str) -> np.ndarray:
        return np.array([float(word) for word in found[key].split()])

    position, velocity = numbers("position_violation_rad"), numbers("velocity_violation_rad_s")
    return {
        "robot": robot,
        "way": way,
        "load": kind,
        **{
            name: int(found[key])
            for name, key in (
                ("periods", "periods"),
                ("missed", "deadline_misses"),
                ("late", "late_periods"),
                ("stopped", "braked_periods"),
            )
        },
        "clearance_rad": float(
            np.minimum(numbers("lower_clearance_rad"), numbers("upper_clearance_rad")).min()
        ),
        "position_violation_rad": float(position.max()),
        "velocity_violation_rad_s": float(velocity.max()),
        "torque_ratio": float(numbers("torque_ratio").max()),
        "passed": found["level"] == b"\x02",
    }


HEAD = (
    "| robot | way | load | periods | missed | late | stopped | nearest limit, rad | beyond, rad "
    "| beyond, rad/s | torque | |\n|" + "---|" * 12
)


def row(found: dict[str, Any]) -> str:
    """Return a line of the table."""
    cells = [
        *(found[key] for key in ("robot", "way", "load", "periods", "missed", "late", "stopped")),
        f"{found['clearance_rad']:.1g}",
        *(f"{found[key]:.2g}" for key in ("position_violation_rad", "velocity_violation_rad_s")),
        f"{found['torque_ratio']:.3f}",
        "**passed**" if found["passed"] else "kept",
    ]
    return "| " + " | ".join(map(str, cells)) + " |"


def main() -> int:
    """Measure, print and write; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0, help="of each run (default: 60)")
    parser.add_argument("--robot", action="append", choices=ROBOTS, help="repeatable")
    parser.add_argument("--way", action="append", choices=[*WAYS], help="repeatable")
    kinds = sorted({kind for each in LOADS.values() for kind in each})
    parser.add_argument("--load", action="append", choices=kinds, help="repeatable")
    parser.add_argument("--imperfect", action="store_true", help="with config/imperfect")
    parser.add_argument("--seed", type=int, default=0, help="of goals and pauses")
    parser.add_argument("--out", type=Path, default=ROOT / "results" / "overload")
    options = parser.parse_args()
    conditions = f"{options.seconds:g} s each; before: {load()}"
    print(f"{conditions}\n\n{HEAD}", flush=True)
    lines, results = [], []
    for robot in options.robot or ROBOTS:
        for way in options.way or WAYS:
            for kind in LOADS[way]:
                if options.load and kind not in options.load:
                    continue
                results.append(measure(robot, way, kind, options.seconds, options))
                lines.append(row(results[-1]))
                print(lines[-1], flush=True)
    try:
        options.out.mkdir(parents=True, exist_ok=True)
        (options.out / "report.md").write_text("\n".join([conditions, "", HEAD, *lines, ""]))
        (options.out / "metrics.json").write_text(json.dumps(results, indent=2) + "\n")
    except OSError as error:
        print(f"error: no report in {options.out}: {error.strerror}", file=sys.stderr)
        return 2
    return int(any(result["passed"] for result in results))


if __name__ == "__main__":
    sys.exit(main())
