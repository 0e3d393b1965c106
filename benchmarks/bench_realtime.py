# SPDX-License-Identifier: Apache-2.0
"""Robot, bounds and controller by the wall clock: one process, separate ones, a bare loop.

Each robot plays its demo's goals by turns in the ways to run it; diagnostics of the robot tell
what was missed: periods without their command in time, and those that passed while the simulated
robot was late itself, whose motion would have gone on.
"both" is what a real robot would miss. A bare loop, which sleeps until the next period and does
nothing else, shows what the machine itself can do; a busy loop, which in each period computes for
as long as the one process, what it leaves to programs that compute; relays in place of bounds and
controller, in the robot's process, what messages and simulation take. Then, in lockstep, where the
time of a period goes.
"""

from __future__ import annotations

import argparse
import itertools
import math
import time
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped
from live_robot import (
    ONE_PROCESS,
    PROCESSES,
    RELAYS,
    Programs,
    User,
    configuration,
    cpu_seconds,
    goals,
    load,
    running,
)
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.task import Future

from sim_bridge.bullet.robot import BulletRobot
from sim_bridge.node.bullet_node import BulletNode
from sim_bridge.node.commands import CommandStream
from torque_safety_controller.controller import Controller
from torque_safety_controller.node.controller_node import ControllerNode
from torque_safety_controller.node.periodic import LimitsReader
from torque_safety_controller.node.safety_stack import make_nodes
from torque_safety_controller.parts.whole_arm.safety_filter import SafetyFilter
from torque_safety_controller.qp import InverseDynamicsQP
from torque_safety_controller.robot_model import RobotModel
from viability_bounds_pkg.cli.command_line import Parser
from viability_bounds_pkg.node.bounds_node import BoundsNode
from viability_bounds_pkg.node.estimator_node import EstimatorNode
from viability_bounds_pkg.recent_values import RecentValues
from viability_bounds_pkg.ros.arm_node import ArmNode, connect
from viability_bounds_pkg.ros.diagnostics import Diagnostics
from viability_bounds_pkg.ros.messages import JointStateReader
from viability_bounds_pkg.ros.program import initialise, leave
from viability_bounds_pkg.ros.publisher_watch import PublisherWatch
from viability_bounds_pkg.ros.runtime import GOAL_QOS, make_executor
from viability_bounds_pkg.state_estimation.estimator import StateEstimator

CASES = (
    ("panda", 500.0),
    ("panda", 1000.0),
    ("talos_left_arm", 1000.0),
    ("baxter_left_arm", 100.0),
)
WAYS = RELAYS, ONE_PROCESS, PROCESSES
SETTLING = 1.0
"""How long a robot moves before it is measured, s."""
LONG_ENOUGH = 6.0
"""For where the time of a period goes, s."""


def memory(programs: Programs) -> float:
    """Return the memory of running programs, what they share counted once, MB."""
    lines = (
        Path(f"/proc/{process.pid}/smaps_rollup").read_text() for process in programs.values()
    )
    return sum(int(text.partition("\nPss:")[2].split()[0]) for text in lines) / 1024


def measure(
    robot: str, rate: float, way: str, seconds: float, imperfect: bool
) -> tuple[str, float]:
    """Run a robot by the wall clock for some seconds; return what came of it.

    Returns:
        the row, and the share of a processor that was used.
    """
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
    periods, missed, stopped, late = (
        int(after[key]) - int(before[key])
        for key in ("periods", "deadline_misses", "braked_periods", "late_periods")
    )
    latency = [float(after[f"latency_{part}_us"]) for part in ("p50", "p99")]
    errors = [float(after[f"period_error_{part}_us"]) for part in ("p50", "p99", "max")]
    return row(way, periods, missed, late, stopped, errors, latency, cpu, megabytes), cpu


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
    return row("busy loop" if busy else "bare loop", periods, 0, lost, 0, found, [], cpu, math.nan)


HEAD = (
    f"{'':12} {'periods':>8} {'missed':>7} {'late':>6} {'both':>7} {'stopped':>8} "
    f"{'period error, us':^25} {'latency, us':^17} {'CPU':>6} {'memory':>7}\n"
    f"{'':52} {'p50':>7} {'p99':>8} {'max':>9} {'p50':>7} {'p99':>9} {'':>6} {'MB':>7}"
)


def row(
    name: str,
    periods: int,
    missed: int,
    late: int,
    stopped: int,
    errors: list[float],
    latency: list[float],
    cpu: float,
    megabytes: float,
) -> str:
    """Return a line of the table."""
    p50, p99 = latency or (math.nan, math.nan)
    text = (
        f"{name:12} {periods:8} {missed:7} {late:6} {(missed + late) / (periods + late):7.2%} "
        f"{stopped:8} "
        f"{errors[0]:7.0f} {errors[1]:8.0f} {errors[2]:9.0f} {p50:7.0f} {p99:9.0f} "
        f"{cpu:6.0%} {megabytes:7.0f}"
    )
    return text.replace("nan", "  -")


class Stopwatch:
    """Adds up the time in functions, without that in others that they call."""

    def __init__(self) -> None:
        self.periods: list[dict[str, float]] = []
        self._now: defaultdict[str, float] = defaultdict(float)
        self._inner = [0.0]

    def watch(self, owner: Any, function: str, stage: str) -> None:
        """Add the time in a function of a class or module to a stage."""
        plain = getattr(owner, function)

        def timed(*arguments: Any, **named: Any) -> Any:
            self._inner.append(0.0)
            begin = time.perf_counter()
            try:
                return plain(*arguments, **named)
            finally:
                took = time.perf_counter() - begin
                self._now[stage] += took - self._inner.pop()
                self._inner[-1] += took

        setattr(owner, function, timed)

    def each(self, owner: Any, function: str) -> None:
        """Let a new period begin where a function is called."""
        plain = getattr(owner, function)

        def counted(*arguments: Any) -> Any:
            self.periods.append(dict(self._now) | {"whole period": time.perf_counter()})
            self._now.clear()
            return plain(*arguments)

        setattr(owner, function, counted)


STAGES = (
    (BulletRobot, "step", "robot: physics"),
    (BulletNode, "_next_state", "robot: state to message"),
    (BulletNode, "_on_command", "robot: rest"),
    (CommandStream, "receive", "robot: command from message"),
    (JointStateReader, "read", "states from messages"),
    (EstimatorNode, "_on_state", "estimator: rest"),
    (EstimatorNode, "_on_command", "estimator: rest"),
    (StateEstimator, "step", "estimator: estimate"),
    (BoundsNode, "_on_state", "bounds"),
    (LimitsReader, "read", "controller: limits from message"),
    (RobotModel, "update", "controller: model"),
    (RobotModel, "torque", "controller: model"),
    (SafetyFilter, "prepare", "controller: safety filter"),
    (SafetyFilter, "choose", "controller: safety filter"),
    (InverseDynamicsQP, "build", "controller: QP"),
    (InverseDynamicsQP, "solve", "controller: QP"),
    (Controller, "step", "controller: rest of the step"),
    (ControllerNode, "_on_state", "controller: rest of the node"),
    (ControllerNode, "_on_limits", "controller: rest of the node"),
    (Publisher, "publish", "publish"),
    (Diagnostics, "publish", "diagnostics"),
    (PublisherWatch, "check", "watch of the graph"),
)
watch = Stopwatch()


def stages(robot: str, rate: float, seconds: float, imperfect: bool) -> None:
    """Print where the time of a period goes, in this process, in lockstep.

    Once with messages past the middleware, once with all of them by it.
    """
    for owner, function, stage in STAGES:
        watch.watch(owner, function, stage)
    watch.each(BulletNode, "_next_state")
    periods = {
        way: stages_of(robot, rate, seconds, imperfect, way == "direct")
        for way in ("direct", "messages")
    }
    whole = {
        way: np.diff([each["whole period"] for each in found[1:]])
        for way, found in periods.items()
    }
    print(f"{'us':35}" + "".join(f"{way:>9} {'mean':>8} {'longest':>9}" for way in periods))
    names = dict.fromkeys(stage for _, _, stage in STAGES)
    counted = {way: np.zeros(len(found) - 2) for way, found in periods.items()}
    for name in [*names, "executor and what is not listed", "whole period"]:
        line = f"{name:35}"
        for way, found in periods.items():
            if name in names:
                times = np.array([each.get(name, 0.0) for each in found[2:]])
                counted[way] += times
            else:
                times = whole[way] - (0.0 if name == "whole period" else counted[way])
            line += "".join(
                f"{1e6 * value:{width}.1f}"
                for value, width in ((np.median(times), 9), (times.mean(), 9), (times.max(), 10))
            )
        print(line)
    ratio = np.median(whole["direct"]) / np.median(whole["messages"])
    print(f"direct / messages: {ratio:.2f} of the period")


def stages_of(
    robot: str, rate: float, seconds: float, imperfect: bool, connected: bool
) -> list[dict[str, float]]:
    """Run the nodes in lockstep for some seconds; return the times of each period by stage, s."""
    arguments = configuration(robot, rate, imperfect=imperfect)
    arguments += [
        "-p",
        "clock:=lockstep",
        "-p",
        "bounds_timeout:=5.0",
        "-p",
        "state_timeout:=10.0",
    ]
    parser = Parser(prog="bench_realtime")
    initialise(parser, ["bench_realtime", "--ros-args", *arguments, "--log-level", "error"])
    watch.periods.clear()
    nodes: list[ArmNode] = [BulletNode(), *make_nodes()]
    if connected:
        connect(nodes)
    user = Node("user")
    publisher = user.create_publisher(PoseStamped, "target_pose", GOAL_QOS)
    turns = itertools.cycle(goals(robot))
    user.create_timer(0.5, lambda: publisher.publish(next(turns)))
    ended: Future[None] = Future()
    user.create_timer(SETTLING + seconds, lambda: ended.set_result(None))

    def settled() -> None:
        begin.cancel()
        watch.periods.clear()

    begin = user.create_timer(SETTLING, settled)
    executor = make_executor()
    for node in (*nodes, user):
        executor.add_node(node)
    while not ended.done():  # without a time-out it runs no callback
        executor.spin_until_future_complete(ended, timeout_sec=seconds)
    leave(*nodes, user)
    return list(watch.periods)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=4.0, help="for each line")
    robots = [f"{robot}@{rate:g}" for robot, rate in CASES]
    parser.add_argument("--case", action="append", choices=robots, help="repeatable; default: all")
    parser.add_argument("--imperfect", action="store_true", help="robots with all remedies")
    parser.add_argument("--only", choices=("ways", "stages"), help="a part of it (default: both)")
    options = parser.parse_args()
    for robot, rate in CASES:
        if options.case and f"{robot}@{rate:g}" not in options.case:
            continue
        print(f"\n{robot} at {rate:g} Hz; {load()}")
        if options.only != "stages":
            print(HEAD)
            print(bare_loop(rate, options.seconds))
            for way in WAYS:
                line, cpu = measure(robot, rate, way, options.seconds, options.imperfect)
                print(line, flush=True)
                if way == ONE_PROCESS:
                    print(bare_loop(rate, options.seconds, min(cpu, 0.95)), flush=True)
        if options.only != "ways":
            stages(robot, rate, min(options.seconds, LONG_ENOUGH), options.imperfect)


if __name__ == "__main__":
    main()
