# SPDX-License-Identifier: Apache-2.0
"""The user of test/two_hosts.sh: gives goals, cuts the link, and checks what the arm does."""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from viability_bounds_pkg.ros.runtime import CONTROL_QOS, GOAL_QOS, LATCHED_QOS
from viability_bounds_pkg.testing.ros_harness import RosHarness, joint_state, read_config

START = 60.0
"""How long programs may take to start, s."""
ANSWER = 5.0
"""How long the arm may take to answer a change of the link, s; far more than it takes."""
FIND = 30.0
"""The same where the hosts have forgotten each other, s."""
REACH = 90.0
"""How long the way to the last goal may take, s: on a busy machine the arm stops now and then."""
CUTS = {"short": 0.4, "longer": 2.0, "long enough to be forgotten": 25.0}
"""How long the link is cut, s. Silent participants leave the ROS graph after 20 s."""
SPEED = 0.1
"""Of an arm in motion, rad/s."""


class Watch:
    """What a process beside the robot sees, while the link is cut, too.

    Attributes:
        seen: the last line of `watch`.
    """

    def __init__(self) -> None:
        self._process = subprocess.Popen(
            ["ip", "netns", "exec", "robot", sys.executable, __file__, "--watch"],
            stdout=subprocess.PIPE,
        )
        assert self._process.stdout is not None
        os.set_blocking(self._process.stdout.fileno(), False)
        self._part = b""
        self.seen: dict[str, Any] = {}

    def look(self) -> None:
        """Read what has come."""
        assert self._process.stdout is not None
        *lines, self._part = (self._part + (self._process.stdout.read() or b"")).split(b"\n")
        if lines:
            self.seen = json.loads(lines[-1])

    def close(self) -> None:
        """End the process."""
        self._process.terminate()
        self._process.wait()


def watch() -> None:
    """Print 20 times a second what the robot does and says, as JSON."""
    ros = RosHarness(int(os.environ["ROS_DOMAIN_ID"]))
    n = len(read_config("panda")["joints"])
    states = ros.listen(JointState, "before_faults/joint_states", CONTROL_QOS)
    while True:
        ros.run_for(0.05)
        if states and "bullet_node" in ros.diagnostics:
            said = {k: v for k, v in ros.diagnostics["bullet_node"].items() if k != "level"}
            q, v = states[-1].position[:n].tolist(), states[-1].velocity[:n].tolist()
            print(json.dumps(said | {"q": q, "v": v}), flush=True)


class Hosts:
    """What runs on both hosts, and the user on each.

    Attributes:
        robot: what is seen beside the robot.
        control: a node beside the controller, where the user gives goals.
        modes: of the controller, as they came.
    """

    def __init__(self, seed: int, programs: list[int]) -> None:
        domain = int(os.environ["ROS_DOMAIN_ID"])
        self._programs = programs
        self._values = read_config("panda")
        low, high = (np.array(self._values[f"position_{end}"]) for end in ("min", "max"))
        self._low, self._high = low, high
        self._random = np.random.default_rng(seed)
        self.robot = Watch()
        self.control = RosHarness(domain)
        self.modes: list[str] = []
        self.control.probe.create_subscription(
            String, "controller_mode", lambda heard: self.modes.append(heard.data), LATCHED_QOS
        )
        self._user = self.control.probe.create_publisher(JointState, "target_posture", GOAL_QOS)
        self._asked = 0.0
        self.goal = self._corner()

    def wait(self, condition: Callable[[], object], what: str, timeout: float) -> float:
        """Run both users until a condition holds; return how long it took, s."""
        begin = time.monotonic()
        while not condition():
            if (now := time.monotonic()) - begin > timeout:
                raise AssertionError(f"not within {timeout:g} s: {what}; {self.told()}")
            if not all(map(alive, self._programs)):
                raise AssertionError(f"a program has ended while waiting for {what}")
            self.robot.look()
            self.control.spin(0.02)
            if now - self._asked > 1.0:  # a goal may be lost while the hosts find each other
                self._asked = now
                self._user.publish(joint_state(self._values["joints"], 0, self.goal))
        return time.monotonic() - begin

    def told(self) -> str:
        """Return what the nodes say of themselves."""
        return (
            f"robot: {self.robot.seen.get('message')}, moves at {self.v.max():.3g} rad/s, "
            f"commands refused: {self.robot.seen.get('commands_refused')}; "
            f"controller: {self.modes[-1:]} {self.control.reported('controller_node', 'reason')}"
        )

    @property
    def v(self) -> np.ndarray:
        """Velocities of the arm, rad/s."""
        return np.abs(self.robot.seen.get("v", [0.0]))

    @property
    def q(self) -> np.ndarray:
        """Positions of the arm, rad."""
        return np.array(self.robot.seen["q"])

    def _corner(self) -> np.ndarray:
        return np.where(self._random.random(len(self._low)) < 0.5, self._low, self._high)

    def wander(self, seconds: float) -> None:
        """Ask for corners of the position limits, one every 2 s."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0.0:
            self.goal, self._asked = self._corner(), 0.0
            until = time.monotonic() + min(2.0, left)
            self.wait(lambda until=until: time.monotonic() > until, "time", 10.0)

    def leaves_rest(self, timeout: float) -> float:
        """Wait until the arm tracks its goal and moves, s."""
        return self.wait(
            lambda: self.modes[-1:] in ([], ["TRACKING"]) and self.v.max() > SPEED,
            "motion",
            timeout,
        )

    def cut(self, seconds: float, found: dict[str, Any]) -> None:
        """Cut the link while the arm moves; note what is seen."""
        self.wander(2.0)
        self.leaves_rest(10.0)
        del self.modes[:]
        with without_link():
            begin = time.monotonic()
            self.wait(lambda: self.v.max() < 0.01, "the robot's own stop", ANSWER)
            found["at_rest_after_s"] = round(time.monotonic() - begin, 2)
            if seconds > 1.0:
                self.wait(lambda: self.modes[-1:] == ["STOPPED"], "STOPPED", ANSWER)
                found["stopped_after_s"] = round(time.monotonic() - begin, 2)
                self.wait(lambda: self.robot.seen["control"] == "stopped", "its report", ANSWER)
            end = begin + seconds
            self.wait(lambda: time.monotonic() > end, "time", seconds + 5.0)
            assert self.v.max() < 0.01, f"the arm moves without commands: {self.v}"
        found["tracking_after_s"] = round(
            self.wait(
                lambda: self.modes[-1:] in ([], ["TRACKING"]),
                "TRACKING",
                FIND if seconds > 20.0 else ANSWER,
            ),
            3,
        )
        found["modes"] = list(self.modes)
        # Towards the far side, so that there is a way to go.
        self.goal = np.where(self.q > 0.5 * (self._low + self._high), self._low, self._high)
        self._asked = 0.0
        found["moving_after_s"] = round(self.leaves_rest(ANSWER + 3.0), 3)

    def reach(self) -> float:
        """Go to the start configuration; return the largest error there, rad."""
        self.goal, self._asked = np.array(self._values["start_positions"]), 0.0
        self.wait(lambda: np.abs(self.q - self.goal).max() < 0.02, "the goal", REACH)
        return float(np.abs(self.q - self.goal).max())

    def report(self) -> dict[str, Any]:
        """Return the next diagnostics of the robot."""
        before = self.robot.seen["periods"]
        self.wait(lambda: self.robot.seen["periods"] != before, "diagnostics", 5.0)
        return self.robot.seen


def alive(process: int) -> bool:
    """Return whether a program runs."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


@contextmanager
def without_link() -> Iterator[None]:
    """Cut the link meanwhile."""

    def ip(*words: str) -> None:
        subprocess.run(["ip", "-n", "robot", *words], check=True)

    ip("link", "set", "robot0", "down")
    try:
        yield
    finally:
        ip("link", "set", "robot0", "up")
        ip("route", "add", "default", "dev", "robot0")  # the system dropped it with the link


def run(hosts: Hosts, seconds: float) -> dict[str, Any]:
    """Move, cut the link, move again; return the numbers."""
    hosts.wait(
        lambda: (
            hosts.robot.seen
            and {"bullet_node", "controller_node", "bounds_node", "estimator_node", "fault_node"}
            <= set(hosts.control.diagnostics)
        ),
        "the programs",
        START,
    )
    hosts.leaves_rest(10.0)
    print("two_hosts: the hosts have found each other, and the arm moves", flush=True)
    hosts.wander(seconds)
    cuts: dict[str, dict[str, Any]] = {}
    for name, length in CUTS.items():
        cuts[name] = {"cut_s": length}
        hosts.cut(length, cuts[name])
        print(f"two_hosts: link cut for {length:g} s: {cuts[name]}", flush=True)
    error = hosts.reach()
    status = hosts.report()

    def largest(key: str) -> float:
        return max(map(float, status[key].split()))

    touched = hosts.control.diagnostics["fault_node"]
    return {
        "position_violation_rad": largest("position_violation_rad"),
        "velocity_violation_rad_s": largest("velocity_violation_rad_s"),
        "torque_ratio": largest("torque_ratio"),
        "nearest_limit_rad": min(
            float(word)
            for end in ("lower", "upper")
            for word in status[f"{end}_clearance_rad"].split()
        ),
        "goal_error_rad": error,
        **{key: int(status[key]) for key in ("periods", "deadline_misses", "braked_periods")},
        "late_periods": int(status["late_periods"]),
        "commands_refused": status["commands_refused"],
        "faults": {key: touched[key] for key in touched if key.startswith("touched_")},
        "cuts": cuts,
        "kept": status["message"] != "a limit was broken",
    }


def main() -> int:
    """Return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--programs", type=lambda text: [int(word) for word in text.split()])
    parser.add_argument("--watch", action="store_true")
    options = parser.parse_args()
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "SUBNET"  # the harness sets LOCALHOST
    if options.watch:
        watch()
    hosts = Hosts(options.seed, options.programs)
    try:
        found = run(hosts, options.seconds)
    except AssertionError as error:
        print(f"two_hosts: FAILED: {error}", file=sys.stderr)
        return 1
    finally:
        hosts.robot.close()
        hosts.control.close()
    print(json.dumps(found, indent=2))
    if options.out:
        options.out.write_text(json.dumps(found, indent=2) + "\n")
    print("two_hosts: limits " + ("kept" if found["kept"] else "PASSED"))
    return 0 if found["kept"] else 1


if __name__ == "__main__":
    sys.exit(main())
