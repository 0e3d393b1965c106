# SPDX-License-Identifier: Apache-2.0
"""What a period of a Franka arm costs in `franka_stack`, stage by stage, without the robot's time.

A simulated FR3 in another process plays the robot. Times are of the processor, so that other
programs do not count; the robot waits for 1000 us.
"""

from __future__ import annotations

import argparse
import itertools
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from sensor_msgs.msg import JointState

from franka_bridge.node.franka_node import FrankaNode
from torque_safety_controller.node.controller_node import ControllerNode
from viability_bounds_pkg.node.bounds_node import BoundsNode
from viability_bounds_pkg.ros.arm_node import ArmNode, connect
from viability_bounds_pkg.ros.program import leave, prepared_executor
from viability_bounds_pkg.ros.runtime import GOAL_QOS
from viability_bounds_pkg.testing.executables import as_child
from viability_bounds_pkg.testing.ros_harness import joint_state, overrides, read_config

ROOT = Path(__file__).resolve().parent.parent
ADDRESS = "127.0.0.77"
ROBOT = ROOT / "install" / "franka_bridge" / "lib" / "franka_bridge" / "simulated_fr3"
START = 60.0
"""How long the robot may take to start, s."""
LISTENERS = {
    "/joint_states": ("bounds_node: limits", "controller_node: state"),
    "/acceleration_limits": ("controller_node: step",),
    "/joint_commands": ("franka_node: torques",),
}
SETTLED = 200  # periods before measuring
GOAL_PERIODS = 1500
"""After so many periods the arm gets another goal."""


class Stages:
    """Processor times of functions, by what they do."""

    def __init__(self) -> None:
        self.times: dict[str, list[float]] = {}

    def timed(self, name: str, act: Callable[..., Any]) -> Callable[..., Any]:
        """Return a function whose times are kept."""
        times = self.times.setdefault(name, [])

        def measured(*given: Any, **more: Any) -> Any:
            begin = time.thread_time()
            try:
                return act(*given, **more)
            finally:
                times.append(1e6 * (time.thread_time() - begin))

        return measured


def watch(stages: Stages, nodes: list[ArmNode]) -> None:
    """Measure the stages of connected nodes."""
    robot: Any = nodes[0]
    for stream in (stream for node in nodes for stream in node.streams):
        names = LISTENERS.get(stream.topic_name, ())
        stream.listeners[:] = map(stages.timed, names, stream.listeners)
    robot._arm.write = stages.timed("  of it libfranka, write", robot._arm.write)
    robot._drive.torque = stages.timed("  of it law of the drives", robot._drive.torque)
    robot._arm.read = stages.timed("libfranka, read", robot._arm.read)
    robot._read = stages.timed("all", robot._read)


def make_node(kind: Any, **more: Any) -> ArmNode:
    """Return a node with the parameters of the robot's file."""
    given = read_config("fr3", kind.NAME) | more
    node: ArmNode = kind(parameter_overrides=overrides(given))
    return node


def main() -> None:
    """Run the benchmark and print medians and 99th percentiles."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--periods", type=int, default=10_000)
    options = parser.parse_args()
    config = ROOT / "config" / "fr3.yaml"
    arguments = ["--ros-args", "--params-file", str(config), "-p", f"robot_ip:={ADDRESS}"]
    simulated = subprocess.Popen([ROBOT, *arguments], preexec_fn=as_child)
    robot = {"robot_ip": ADDRESS, "real_time": False}
    rclpy.init()
    nodes: list[ArmNode] = []
    deadline = time.monotonic() + START
    while not nodes:
        try:
            nodes.append(make_node(FrankaNode, **robot))
        except ValueError as error:
            if time.monotonic() > deadline or simulated.poll() is not None:
                sys.exit(f"error: {error}")
    nodes += map(make_node, (BoundsNode, ControllerNode))
    connect(nodes)
    stages = Stages()
    watch(stages, nodes)
    executor = prepared_executor(nodes)
    values = read_config("fr3")
    joints, start = values["joints"], np.array(values["start_positions"])
    goals = itertools.cycle([start + 0.3, start - 0.3])
    publisher = nodes[1].create_publisher(JointState, "target_posture", GOAL_QOS)
    sent = 0
    while len(stages.times["all"]) < options.periods + SETTLED:
        executor.spin_once(timeout_sec=1.0)
        if len(stages.times["all"]) >= sent * GOAL_PERIODS:
            sent += 1
            publisher.publish(joint_state(joints, 0, q=next(goals)))
    for name, times in stages.times.items():
        if times:
            median, slow = np.percentile(times[SETTLED:], (50, 99))
            print(f"{name:>30}: median {median:6.0f} us, 99% {slow:6.0f} us")
    leave(*nodes)
    simulated.terminate()


if __name__ == "__main__":
    main()
