# SPDX-License-Identifier: Apache-2.0
"""Runs the nodes of a robot by the wall clock as users do, sends them goals, and disturbs them."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from geometry_msgs.msg import PoseStamped
from std_srvs.srv import SetBool

from viability_bounds_pkg.ros.runtime import GOAL_QOS
from viability_bounds_pkg.testing.executables import as_child
from viability_bounds_pkg.testing.ros_harness import RosHarness

ROOT = Path(__file__).resolve().parent.parent
ONE_PROCESS, PROCESSES, RELAYS = "one process", "processes", "relays"
RELAY_PROGRAM = Path(__file__).parent / "relays.py"
WAYS = {
    ONE_PROCESS: (("sim_bridge", "simulated_stack"),),
    PROCESSES: (
        ("sim_bridge", "bullet_node"),
        ("viability_bounds_pkg", "bounds_node"),
        ("torque_safety_controller", "controller_node"),
    ),
}
"""Programs that run, each with its package."""

START = 60.0
"""How long programs may take to start, s."""
PAUSES, BETWEEN = (0.005, 0.5), (0.05, 0.8)
"""Shortest and longest pause of a program, and time between two, s."""

Programs = dict[str, subprocess.Popen[bytes]]


def configuration(robot: str, rate: float | None = None, *, imperfect: bool) -> list[str]:
    """Return the arguments that all programs of a robot get; None for its own rate."""
    files = [f"config/{robot}.yaml", *([f"config/imperfect/{robot}.yaml"] * imperfect)]
    given = [word for each in files for word in ("--params-file", str(ROOT / each))]
    return given if rate is None else [*given, "-p", f"rate_hz:={rate}"]


def goals(robot: str) -> list[PoseStamped]:
    """Return the poses that a robot's demo goes to."""
    scenario = yaml.safe_load((ROOT / "config" / "scenarios" / f"{robot}_demo.yaml").read_text())
    found = []
    for pose in (event["pose"] for event in scenario["events"] if "pose" in event):
        message = PoseStamped()
        p, o = message.pose.position, message.pose.orientation
        p.x, p.y, p.z = pose["position"]
        o.x, o.y, o.z, o.w = pose["orientation"]
        found.append(message)
    return found


class User:
    """What is outside of the programs: gives goals by turns, and reads diagnostics.

    Args:
        messages: goals, sent one after the other, again and again.
        topic: theirs.
    """

    def __init__(self, messages: list[Any], topic: str) -> None:
        self.ros = RosHarness(int(os.environ["ROS_DOMAIN_ID"]))
        self._goals = cycle(messages)
        self._publisher = self.ros.probe.create_publisher(type(messages[0]), topic, GOAL_QOS)

    def start(self, programs: Programs) -> None:
        """Wait for the programs, and let robot time begin."""

        def ready() -> bool:
            if any(program.poll() is not None for program in programs.values()):
                raise SystemExit("error: a program could not start")
            if RELAYS in programs:
                return "bullet_node" in self.ros.diagnostics
            found = {"bullet_node", "bounds_node", "controller_node"} <= set(self.ros.diagnostics)
            return found and self._publisher.get_subscription_count() > 0

        self.ros.wait_until(ready, "the programs", timeout=START)
        self.ros.call(SetBool, "bullet_node/pause", SetBool.Request(data=False))

    def use(self, seconds: float, each: float = 1.0) -> None:
        """Give a goal every `each` s."""
        self.ros.run_for(seconds, lambda: self._publisher.publish(next(self._goals)), period=each)

    def report(self, node: str = "bullet_node") -> dict[str, Any]:
        """Return the next diagnostics of a node."""
        self.ros.diagnostics.pop(node, None)
        self.ros.wait_until(lambda: node in self.ros.diagnostics, node)
        return self.ros.diagnostics[node]


@contextmanager
def running(way: str, arguments: list[str], imperfect: bool) -> Iterator[Programs]:
    """Run the programs of a way; yield them by name.

    Args:
        way: one of `WAYS`, or `RELAYS`: the robot, and relays in place of bounds and controller.
        arguments: for ROS.
        imperfect: whether there is an estimator.
    """
    commands: dict[str, list[Any]] = {RELAYS: [sys.executable, RELAY_PROGRAM]}
    if way != RELAYS:
        programs = WAYS[way]
        if way == PROCESSES and imperfect:
            programs += (("viability_bounds_pkg", "estimator_node"),)
        commands = {
            name: [ROOT / "install" / package / "lib" / package / name]
            for package, name in programs
        }
    started = {
        name: subprocess.Popen(
            [*command, "--ros-args"]
            + [*arguments, "--log-level", "error", "-p", "start_paused:=true"],
            preexec_fn=as_child,
        )
        for name, command in commands.items()
    }
    try:
        yield started
    finally:
        for program in started.values():
            program.terminate()
        for program in started.values():
            program.wait()


@contextmanager
def busy_machine() -> Iterator[None]:
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
    """Stop programs together (SIGSTOP) at random times, and let them go on."""
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


def disturbed(kind: str, programs: Programs, rng: np.random.Generator) -> Any:
    """Return the context of a load: "idle", "busy", or "pause NAME" of a program, or of all."""
    if kind == "idle":
        return nullcontext()
    if kind == "busy":
        return busy_machine()
    name = kind.removeprefix("pause ")
    return pauses([each for key, each in programs.items() if name in (key, "all")], rng)


def cpu_seconds(programs: Programs) -> float:
    """Return the time on processors of running programs, s."""
    ticks = 0
    for process in programs.values():
        fields = Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()
        ticks += int(fields[11]) + int(fields[12])
    return ticks / os.sysconf("SC_CLK_TCK")


def load() -> str:
    """Return how busy the machine is."""
    return f"{os.cpu_count()} processors, load {' '.join(f'{x:.1f}' for x in os.getloadavg())}"
