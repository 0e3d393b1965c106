# SPDX-License-Identifier: Apache-2.0
"""Each kind of fault between the nodes at random moments, in real time: limits, braking, return.

bash scripts/reproduce.sh faults [--robot NAME] [--fault NAME] [--moments N] [--rate HZ]
    [--hold PERIODS]

Bounds and controller are a process, `safety_stack`; the robot is in this one, so that its limits
are judged at its physics steps, and so is the fault node, by which one kind of messages goes at a
time: each message that it passes takes a part of the period. Goals are random corners of the
position limits, one a second, with stiff gains; from the start of a fault until the arm goes on
the goal stays what it was.
"""

from __future__ import annotations

import argparse
import tempfile
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from chain import ROOT, load_node_values, load_values
from figure import Figure, table
from moments import (
    EVERY,
    HEADS,
    ROBOTS,
    STIFF,
    Corners,
    Sample,
    Seen,
    at_rate,
    parameter_words,
)
from numpy.typing import NDArray
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from watched_robot import WatchedRobot

from sim_bridge.nodes.bullet_node import BulletNode
from sim_bridge.nodes.fault_node import BEFORE, FaultNode
from torque_safety_controller.node.controller_node import ControllerNode
from torque_safety_controller.safety.modes import Mode
from viability_bounds_pkg.node.bounds_node import BoundsNode
from viability_bounds_pkg.ros.runtime import GOAL_QOS, LATCHED_QOS
from viability_bounds_pkg.testing.node_program import NodeProgram
from viability_bounds_pkg.testing.ros_harness import (
    RosHarness,
    joint_state,
    overrides,
    private_domain,
)

Array = NDArray[np.float64]

SENDERS = {
    "joint_states": BulletNode,
    "acceleration_limits": BoundsNode,
    "joint_commands": ControllerNode,
}
DURATION = 0.6  # s of a fault
TWO_JOINTS = "[second, fourth]"  # of the robot's own names
EPISODE = 4.0  # s from one to the next
RECOVERY = 1.0  # s after a fault before there is another goal


class Kind(NamedTuple):
    """A kind of fault.

    Attributes:
        topic: whose messages it spoils.
        what: it does to them, as in a file of faults.
        brakes: whether the arm has to brake: none of the messages can be used. Where it leaves
            some that can, limits have to be kept, and the goal to be followed again afterwards.
        believed: states at its begin that are answered before it can be told: the first one of
            what freezes is right; velocities that are the same must be so for 10 ms; a sender is
            known a moment after it has begun.
    """

    topic: str
    what: str
    brakes: bool = True
    believed: int = 0


FAULTS = {
    "states lost": Kind("joint_states", "drop: "),
    "limits lost": Kind("acceleration_limits", "drop: "),
    "commands lost": Kind("joint_commands", "drop: "),
    # Those that come can be used; the robot may stop itself after a long row of lost ones.
    "a third of the states lost": Kind("joint_states", "drop: {probability: 0.33}", brakes=False),
    "commands 20 ms late": Kind("joint_commands", "delay: {delay: 0.02}"),
    "a burst of commands": Kind("joint_commands", "burst: "),
    # The second one says what the first did.
    "states twice": Kind("joint_states", "duplicate: ", brakes=False),
    # Every second state is the newest one when it comes.
    "states in another order": Kind("joint_states", "reorder: ", brakes=False),
    "states not finite": Kind("joint_states", "corrupt: {how: nan}"),
    "limits not finite": Kind("acceleration_limits", "corrupt: {how: nan}"),
    "commands not finite": Kind("joint_commands", "corrupt: {how: nan}"),
    "states of other joints": Kind("joint_states", "corrupt: {how: names}"),
    "joints swapped": Kind("joint_states", f"swap: {{joints: {TWO_JOINTS}}}"),
    "degrees for radians": Kind("joint_states", "scale: {factor: 57.3}"),
    "states frozen": Kind("joint_states", "freeze: ", believed=6),
    "positions frozen": Kind("joint_states", "freeze: {field: position}", believed=2),
    "positions with a bias": Kind("joint_states", "bias: {offset: 0.3, field: position}"),
    "velocities with a bias": Kind(
        "joint_states", "bias: {offset: 0.6, field: velocity}", believed=1
    ),
    "stamps of the past": Kind("joint_states", "stamp: {offset: -0.3}"),
    "stamps of the future": Kind("joint_states", "stamp: {offset: 0.3}"),
    # A sender that is not in the graph yet is not obeyed; the right one is, until then.
    "another robot": Kind("joint_states", "rival: {offset: 0.5}", believed=1),
    "other limits": Kind("acceleration_limits", "rival: {offset: 50}", believed=1),
    "another controller": Kind("joint_commands", "rival: {offset: 5}"),
}


class Bench:
    """A robot under control, some messages by way of a fault node.

    Args:
        ros: runs the nodes.
        robot: name of its file.
        topic: of the messages that go by way of the fault node.
        seed: of goals and moments.
        rate: of the control loop, Hz; None for the robot's own.
        own: parameters that differ from the file, by name.
    """

    def __init__(
        self,
        ros: RosHarness,
        robot: str,
        topic: str,
        seed: int,
        rate: float | None,
        own: dict[str, Any],
    ) -> None:
        self._ros, self._topic, self._rng = ros, topic, np.random.default_rng(seed)
        own = STIFF | {"start_paused": False, "clock": "real_time"} | own
        # Of each its own: the bounds of TALOS keep speeds below those that the robot may have.
        found = load_node_values(robot)
        changes = {name: own | new for name, new in at_rate(found, rate).items()}
        self._values = found[BulletNode.NAME] | changes[BulletNode.NAME]
        self._trace: list[Sample] = []
        self._mode = ""
        away = ["-r", f"{SENDERS[topic].NAME}:{topic}:={BEFORE}{topic}"]
        words = ["--ros-args", "--params-file", str(ROOT / "config" / f"{robot}.yaml")]
        for name in (BoundsNode.NAME, ControllerNode.NAME):
            words += parameter_words(name, changes[name])
        # What renames no topic of the stack would be warned of.
        words += away if SENDERS[topic] is not BulletNode else []
        self._stack = NodeProgram("safety_stack", ros.domain, words)
        self._stack.start()
        self._arm = ros.add(
            WatchedRobot(
                self._see,
                context=ros.context,
                parameter_overrides=overrides(self._values),
                cli_args=["--ros-args", *away],
            )
        )
        ros.probe.create_subscription(String, "controller_mode", self._on_mode, LATCHED_QOS)
        self._user = ros.talk(JointState, "target_posture", GOAL_QOS)
        self._corners = Corners(self._values, self._rng)
        self._dt = 1.0 / self._values["rate_hz"]

    def close(self) -> None:
        """End the program."""
        self._stack.end()

    def _on_mode(self, message: String) -> None:
        self._mode = message.data

    def _see(self, t: float, stopped: bool, tau: Array) -> None:
        braking = stopped or self._mode != Mode.TRACKING.value
        self._trace.append(Sample(t, braking, stopped, tau))

    def _ask(self) -> None:
        self._user.publish(joint_state(self._values["joints"], 0, self._corners.draw()))

    def suffer(self, names: list[str], moments: int, folder: Path) -> list[Seen]:
        """Let faults happen at random moments, one kind after the other; return what each did.

        Args:
            names: kinds, all of the messages that go by way of the fault node.
            moments: of each.
            folder: for the file of faults.
        """
        count = len(names) * moments
        begins = 2.0 + EPISODE * np.arange(count) + self._rng.uniform(0.0, 1.0, count)
        entries = "\n".join(
            f"  - {{time: {begin:.4f}, duration: {DURATION}, topic: {topic}, {what}}}"
            for begin, (topic, what, *_) in zip(
                begins.tolist(),
                (FAULTS[name] for name in names for _ in range(moments)),
                strict=True,
            )
        )
        joints = self._values["joints"]
        entries = entries.replace(TWO_JOINTS, f"[{joints[1]}, {joints[3]}]")
        path = folder / "faults.yaml"
        path.write_text(f"topics: [{self._topic}]\nfaults:\n{entries}\n")
        self._ros.wait_until(lambda: self._mode, "the controller")
        faults: Any = self._ros.start(FaultNode, {"faults": str(path)})
        self._ros.wait_until(lambda: faults._begin >= 0, "the first state")
        start = 1e-9 * faults._begin
        return [
            self._suffer(start + some, FAULTS[name])
            for name, some in zip(names, begins.reshape(-1, moments), strict=True)
        ]

    def _suffer(self, begins: np.ndarray, kind: Kind) -> Seen:
        """Go on until after the last of these moments; return what happened."""
        monitor, trace, asked = self._arm._monitor, self._trace, -np.inf
        monitor.reset()
        trace.clear()
        while not trace or trace[-1].t < begins[-1] + EPISODE - 1.5:
            now = trace[-1].t if trace else -np.inf
            if trace and now - asked > 1.0:
                calm = (now < begins) | (now > begins + DURATION + RECOVERY)
                if calm.all():
                    self._ask()
                    asked = now
            self._ros.spin(0.05)
        timeout = self._arm.get_parameter("command_timeout").value
        seen = Seen(timeout=timeout, brakes=kind.brakes, believed=kind.believed)
        seen.note_limits(monitor)
        tau_max = np.array(self._values["torque_max"])
        for begin in begins.tolist():
            seen.note_moment(trace, begin, begin + DURATION, self._dt, tau_max)
        return seen


def play(
    robot: str, names: list[str], moments: int, rate: float | None, own: dict[str, Any]
) -> list[tuple[str, dict[str, Any]]]:
    """Let a robot suffer these faults; return what each did."""
    seen: dict[str, dict[str, Any]] = {}
    for topic in SENDERS:
        some = [name for name in names if FAULTS[name].topic == topic]
        if not some:
            continue
        with ExitStack() as stack:
            ros = RosHarness(stack.enter_context(private_domain()))
            stack.callback(ros.close)
            bench = Bench(ros, robot, topic, 1, rate, own)
            stack.callback(bench.close)
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
            seen |= zip(some, map(vars, bench.suffer(some, moments, folder)), strict=True)
    return [(name, seen[name]) for name in names]


def main() -> int:
    """Play, print the table; return whether all is as it should be."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--robot",
        action="append",
        choices=EVERY,
        help=f"repeatable; default: {' and '.join(ROBOTS)}",
    )
    parser.add_argument("--fault", action="append", choices=tuple(FAULTS), help="only this one")
    parser.add_argument("--moments", type=int, default=10, help="of each fault")
    parser.add_argument(
        "--hold", type=int, help="periods for which the robot holds a command; the robot's own"
    )
    parser.add_argument(
        "--rate",
        type=float,
        help="of the control loop, Hz; the robot's own; at a lower one its file is changed for it",
    )
    given = parser.parse_args()
    own = {} if given.hold is None else {"command_timeout": given.hold}
    robots, names = given.robot or ROBOTS, given.fault or list(FAULTS)
    figure = Figure("faults")
    with ProcessPoolExecutor(len(robots), get_context("spawn")) as pool:
        runs = [
            (robot, pool.submit(play, robot, names, given.moments, given.rate, own))
            for robot in robots
        ]
        for robot, run in runs:
            dt = 1.0 / (given.rate or load_values(robot)["rate_hz"])
            for name, seen in run.result():
                figure.rows.append((robot, name, *Seen(**seen).cells(dt)))
    print(table([figure], HEADS))
    return int(any(row[-1] != "kept" for row in figure.rows))


if __name__ == "__main__":
    raise SystemExit(main())
