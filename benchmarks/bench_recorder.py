# SPDX-License-Identifier: Apache-2.0
"""What a recorder costs the control: none, one that records all, one that stands still.

`simulated_stack` plays goals in lockstep, as fast as it can, and by the wall clock, while another
process records what the scenario player records, or is stopped (SIGSTOP) while its subscriptions
stay. In lockstep the speed is robot time per wall time, and per processor time of the stack, which
tells the speed of an idle machine on one that is busy; by the wall clock, the latency.
"""

from __future__ import annotations

import argparse
import signal
import subprocess
import sys
import time
from contextlib import suppress
from functools import partial

import rclpy
from live_robot import (
    ONE_PROCESS,
    START,
    User,
    configuration,
    cpu_seconds,
    goals,
    load,
    running,
)
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.task import Future

from sim_bridge.nodes.run_listener import RunListener
from viability_bounds_pkg.ros.runtime import make_executor
from viability_bounds_pkg.testing.executables import as_child
from viability_bounds_pkg.testing.ros_harness import read_config

CASES = (("panda", 500.0), ("talos_left_arm", 1000.0))
RECORDERS = ("none", "recording", "stopped")
SETTLING = 1.0
"""How long a robot moves before it is measured, s."""
LOCKSTEP = ["-p", "clock:=lockstep", "-p", "bounds_timeout:=5.0", "-p", "state_timeout:=10.0"]


def record(robot: str) -> None:
    """Record until SIGTERM; print in how many periods state, limits and command were recorded.

    Prints "ready" when the first state has come.
    """
    rclpy.init()
    node = Node("recorder")
    listener = RunListener(node, read_config(robot)["joints"])
    executor = make_executor()
    executor.add_node(node)
    ready, begin = False, time.monotonic()
    with suppress(ExternalShutdownException):
        while rclpy.ok():
            executor.spin_until_future_complete(Future(), timeout_sec=0.1)
            if not ready and listener.stamp >= 0:
                ready = True
                print("ready", flush=True)
            if not ready and time.monotonic() - begin > START:
                raise SystemExit("error: no joint states came")
    if ready:
        run = listener.run(0)
        print(len(run.t) - run.lost, flush=True)


class Recorder:
    """A process that records.

    Args:
        robot: name of the robot.
    """

    def __init__(self, robot: str) -> None:
        self._process = subprocess.Popen(
            [sys.executable, __file__, "--record", robot],
            stdout=subprocess.PIPE,
            text=True,
            preexec_fn=partial(as_child, signal.SIGKILL),  # it may stand still
        )
        assert self._process.stdout is not None
        self._process.stdout.readline()

    def stand_still(self) -> None:
        """Do nothing from now on, with all subscriptions."""
        self._process.send_signal(signal.SIGSTOP)

    def end(self) -> int:
        """End the process; return how many periods it has."""
        self._process.send_signal(signal.SIGCONT)
        self._process.terminate()
        return int(self._process.communicate()[0])


def measure(robot: str, rate: float, lockstep: bool, recorder: str, seconds: float) -> str:
    """Run a robot for some seconds; return the line of what came of it."""
    arguments = configuration(robot, rate, imperfect=False) + LOCKSTEP * lockstep
    with running(ONE_PROCESS, arguments, imperfect=False) as programs:
        user = User(goals(robot), "target_pose")
        recording = None if recorder == "none" else Recorder(robot)
        try:
            user.start(programs)
            user.use(SETTLING)
            if recording is not None and recorder == "stopped":
                recording.stand_still()
            before, used, begin = user.report(), cpu_seconds(programs), time.monotonic()
            user.use(seconds)
            after, cpu = user.report(), cpu_seconds(programs) - used
            passed = time.monotonic() - begin
        finally:
            recorded = recording.end() if recording is not None else 0
            user.ros.close()
    played = 1e-9 * (int(after["stamp_ns"]) - int(before["stamp_ns"]))
    late, missed = (
        int(after[key]) - int(before[key]) for key in ("late_periods", "deadline_misses")
    )
    latency = [float(after[f"latency_{part}_us"]) for part in ("p50", "p99")]
    text = f"{'lockstep' if lockstep else 'real time':10} {recorder:10}"
    text += f"{recorded:9} {latency[0]:9.0f} {latency[1]:7.0f}"
    if lockstep:
        return text + f"{played / passed:18.2f} {played / cpu:13.2f}"
    return text + f"{'':32}{missed:7} {late:6}"


HEAD = (
    f"{'':10} {'recorder':10}{'recorded':>9} {'latency, us':>17}{'times real time':>18} "
    f"{'of processor':>13}{'missed':>7} {'late':>6}\n{'':21}{'periods':>9} {'p50':>9} {'p99':>7}"
)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=4.0, help="for each line")
    parser.add_argument("--record", metavar="ROBOT", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.record:
        record(options.record)
        return
    for robot, rate in CASES:
        print(f"\n{robot} at {rate:g} Hz; {load()}\n{HEAD}")
        for lockstep in (True, False):
            for recorder in RECORDERS:
                print(measure(robot, rate, lockstep, recorder, options.seconds), flush=True)


if __name__ == "__main__":
    main()
