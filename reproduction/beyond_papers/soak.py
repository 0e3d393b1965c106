# SPDX-License-Identifier: Apache-2.0
"""Faults one after the other, while an arm goes to random goals at its limits.

Robot, bounds and controller run by the wall clock in a process each, as users run them. A fault
is made, and ended; then the arm must move again, soon: a program that was killed has started again
and reports by then. The robot itself tells whether a limit was passed in any physics step.
"""

from __future__ import annotations

import argparse
import math
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any, NamedTuple

import numpy as np
from chain import ROOT, load_values
from direct import posture_at_limits
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool
from trajectory_msgs.msg import JointTrajectory

from viability_bounds_pkg.ros.runtime import GOAL_QOS, stamp_to_ns
from viability_bounds_pkg.ros.topics import ACCELERATION_LIMITS, JOINT_COMMANDS, JOINT_STATES
from viability_bounds_pkg.testing.executables import as_child
from viability_bounds_pkg.testing.ros_harness import (
    RosHarness,
    acceleration_limits,
    joint_state,
    private_domain,
)

PROGRAMS = {
    "bullet_node": "sim_bridge",
    "bounds_node": "viability_bounds_pkg",
    "controller_node": "torque_safety_controller",
}
START = 60.0
"""How long programs may take to start, s."""
SOON, MOTION = 5.0, 0.02
"""After so long at the latest the arm moves again, s, and by how much a joint has to, rad."""
NEW_GOAL, FAULT = 0.5, 1.0
"""Time between goals, and how long a fault lasts at least, s."""
KEPT = {"position_violation_rad": 0.0, "velocity_violation_rad_s": 0.0, "torque_ratio": 1.0 + 1e-9}
"""What the robot reports, and what it may be."""


class Round(NamedTuple):
    """What came of a fault.

    Attributes:
        fault: its name.
        passed: which limits have been passed in it, in words; empty for none.
        again: until the arm moved again, s; infinite where it did not.
    """

    fault: str
    passed: str
    again: float


class Soak:
    """A running stack, its user, and what happens to both.

    Args:
        robot: name of a file in ``config/``.
        domain: of ROS.
    """

    def __init__(self, robot: str, domain: int) -> None:
        values = load_values(robot)
        self.joints: list[str] = values["joints"]
        self.tau_max = np.array(values["torque_max"])
        self._low, self._high = (np.array(values[f"position_{end}"]) for end in ("min", "max"))
        self._rng = np.random.default_rng(0)
        self._words = ["--ros-args", "--params-file", str(ROOT / "config" / f"{robot}.yaml")]
        self._words += ["--log-level", "fatal", "-p", "start_paused:=true"]
        self._words += ["-p", "posture_kp:=25.0", "-p", "posture_kd:=10.0"]
        self._running: dict[str, subprocess.Popen[bytes]] = {}
        self.ros = RosHarness(domain)
        self._goals = self.ros.probe.create_publisher(JointState, "target_posture", GOAL_QOS)
        self._q = np.full(len(self.joints), math.nan)
        self.ros.probe.create_subscription(
            JointState, "joint_states", self._on_state, JOINT_STATES.qos
        )
        self._worst = dict(KEPT)

    def _on_state(self, message: JointState) -> None:
        places = dict(zip(message.name, message.position, strict=False))
        self._q = np.array([places.get(name, math.nan) for name in self.joints])

    def start(self, *names: str) -> None:
        """Start programs, and wait until they report."""
        for name in names:
            program = ROOT / "install" / PROGRAMS[name] / "lib" / PROGRAMS[name] / name
            self._running[name] = subprocess.Popen(
                ["env", f"ROS_DOMAIN_ID={self.ros.domain}", program, *self._words],
                preexec_fn=as_child,
            )
            self.ros.diagnostics.pop(name, None)

        def ready() -> bool:
            for name, program in self._running.items():
                if program.poll() is not None:
                    raise SystemExit(f"error: {name} has ended")
            return set(names) <= set(self.ros.diagnostics)

        self.ros.wait_until(ready, f"{', '.join(names)}", START, self.give_goal, NEW_GOAL)

    def begin(self) -> None:
        """Let robot time begin."""
        self.ros.call(SetBool, "bullet_node/pause", SetBool.Request(data=False))

    def kill(self, name: str) -> None:
        """End a program without a warning."""
        program = self._running.pop(name)
        program.kill()
        program.wait()

    def close(self) -> None:
        """End everything."""
        for name in list(self._running):
            self.kill(name)
        self.ros.close()

    def give_goal(self) -> None:
        """Send the arm to a random posture, some of whose joints are at limits."""
        goal = posture_at_limits(self._rng, self._low, self._high)
        self._goals.publish(joint_state(self.joints, 0, goal))

    def play(self, seconds: float) -> None:
        """Let time pass, with goals."""
        self.ros.run_for(seconds, self.give_goal, NEW_GOAL)

    def until_motion(self) -> float:
        """Return how long the arm takes to move, s; infinite where it stands for too long."""
        begin, first = time.monotonic(), None
        while time.monotonic() < begin + 2.0 * SOON:
            self.play(0.1)
            if first is None or not np.isfinite(first).all():
                first = self._q
            elif np.abs(self._q - first).max() > MOTION:
                return time.monotonic() - begin
        return math.inf

    def passed(self) -> str:
        """Return which limits have been passed since the last call, in words."""
        self.ros.diagnostics.pop("bullet_node", None)
        robot = self.ros.wait_until(lambda: self.ros.diagnostics.get("bullet_node"), "the robot")
        found = []
        for key, before in self._worst.items():
            worst = float(np.max(np.array(robot[key].split(), dtype=float)))
            if not worst <= before:  # a NaN is not
                found.append(f"{key} {worst:.3g}")
                self._worst[key] = worst
        return ", ".join(found)

    def run(self, name: str) -> Round:
        """Make a fault, end it, and return what came of it."""
        self.play(FAULT)
        FAULTS[name](self)
        again = self.until_motion()
        return Round(name, self.passed(), again)


def restart(name: str) -> Callable[[Soak], None]:
    """Return the fault that a program is killed, and started again."""

    def fault(soak: Soak) -> None:
        soak.kill(name)
        soak.play(FAULT)
        soak.start(name)

    return fault


def intrude(topic: Any, wrong: Callable[[Soak, int, float], Any]) -> Callable[[Soak], None]:
    """Return the fault that a second node publishes on a topic.

    Args:
        topic: a stream.
        wrong: makes a message for a stamp, ns, and a sign that changes each time.
    """

    def fault(soak: Soak) -> None:
        node = Node("driver", context=soak.ros.context, namespace="theirs")
        publisher = topic.publisher(node, f"/{topic.name}")
        last, sent = [], []

        def remember(state: JointState) -> None:
            if np.isfinite(state.position).all():
                last[:] = [stamp_to_ns(state.header.stamp)]

        def answer() -> None:
            if last:
                sent.append((-1.0) ** len(sent))
                publisher.publish(wrong(soak, last[0], sent[-1]))

        node.create_subscription(JointState, "/joint_states", remember, JOINT_STATES.qos)
        timer = node.create_timer(0.01, answer)
        soak.ros.add(node)
        soak.play(FAULT)
        timer.cancel()
        soak.ros.stop(node)
        if not sent:
            raise SystemExit("error: the fault did not happen")

    return fault


def state(soak: Soak, stamp: int, q: float, v: float) -> JointState:
    """Return a state that is later than the robot's, alike for all joints."""
    n = len(soak.joints)
    return joint_state(soak.joints, stamp + 1000, [q] * n, [v] * n)


def limits(soak: Soak, stamp: int, _: float) -> JointTrajectory:
    """Return limits that are none."""
    wide = 100.0 * np.ones(len(soak.joints))
    return acceleration_limits(soak.joints, stamp, -wide, wide)


FAULTS: dict[str, Callable[[Soak], None]] = {
    "nothing": lambda soak: soak.play(FAULT),
    "controller killed, restarted": restart("controller_node"),
    "bounds killed, restarted": restart("bounds_node"),
    "states that are not numbers": intrude(
        JOINT_STATES, lambda soak, stamp, _: state(soak, stamp, math.nan, math.nan)
    ),
    "impossible states": intrude(
        JOINT_STATES, lambda soak, stamp, sign: state(soak, stamp, sign, 10.0 * sign)
    ),
    "a second node with limits": intrude(ACCELERATION_LIMITS, limits),
    "a second node with commands": intrude(
        JOINT_COMMANDS,
        lambda soak, stamp, sign: joint_state(soak.joints, stamp, tau=sign * soak.tau_max),
    ),
}


def main() -> int:
    """Run the faults, print a table; return 1 where one was not overcome."""
    parser = argparse.ArgumentParser(prog="reproduce.sh soak", description=__doc__)
    parser.add_argument("--robot", default="panda", help="a file in config/ (panda)")
    parser.add_argument("--rounds", type=int, default=3, help="how often each fault is made (3)")
    options = parser.parse_args()
    found = []
    with ExitStack() as stack:
        soak = Soak(options.robot, stack.enter_context(private_domain()))
        stack.callback(soak.close)
        soak.start(*PROGRAMS)
        soak.begin()
        print(f"{'fault':32}{'limits':10}{'moves again after, s':>22}", flush=True)
        for name in options.rounds * list(FAULTS):
            found.append(soak.run(name))
            _, passed, again = found[-1]
            print(f"{name:32}{passed or 'kept':10}{again:>22.1f}", flush=True)
    return int(any(each.passed or each.again > SOON for each in found))


if __name__ == "__main__":
    sys.exit(main())
