# SPDX-License-Identifier: Apache-2.0
"""A robot driven for long in real time, with goals, pushes, and all that can go wrong.

bash scripts/soak.sh [--minutes N] [--robot NAME] [--seed N] [--processes]

What is promised: no limit is passed at any physics step, the arm goes on by itself after each
fault, no program ends, memory does not grow. Exits with 0 when all of it was kept, 1 when not.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
from faults import SENDERS
from figure import RESULTS
from geometry_msgs.msg import PoseStamped, WrenchStamped
from moments import EVERY, STIFF
from rcl_interfaces.srv import SetParameters
from rclpy.node import Node
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState
from soak_plan import LEAD, Arm, Slot, slots, timeline
from soak_record import Episode, Memory, Record
from std_msgs.msg import String

from sim_bridge.nodes.fault_node import BEFORE
from torque_safety_controller.safety.modes import Mode
from viability_bounds_pkg.ros.messages import pose_message
from viability_bounds_pkg.ros.runtime import CONTROL_QOS, GOAL_QOS, LATCHED_QOS, stamp_to_ns
from viability_bounds_pkg.testing.node_program import NodeProgram
from viability_bounds_pkg.testing.ros_harness import RosHarness, joint_state, private_domain

ROOT = Path(__file__).resolve().parents[2]
ONE, PROCESSES = ("simulated_stack",), ("bullet_node", "bounds_node", "controller_node")
PAUSED, RESTARTED, KILLED = "stands still", "started again", "killed"
START = 60.0  # s, in which programs must start
LOOK = 0.05  # s between looks at the state
GOAL_TIME = 5.0  # s for a goal
SENT_AGAIN = 1.0  # s after which a goal is sent again: a node may not have been there
NEAR = 0.02, 0.01  # rad and m from a goal at which it is reached
PUSH_EVERY, PUSH_TIME = 7.0, 0.4  # s
SHOWN, SHOWN_IN_FILE = 2.0, 60.0  # s between lines
MEMORY_EVERY = 5.0  # s


class Soak:
    """A robot, what is done to it, and what is seen of it.

    Args:
        ros: of the user.
        options: of the command line.
        folder: for files.
        arm: its model.
        rng: random numbers.
    """

    def __init__(
        self,
        ros: RosHarness,
        options: argparse.Namespace,
        folder: Path,
        arm: Arm,
        rng: np.random.Generator,
    ) -> None:
        self._ros, self._options, self._arm, self._rng = ros, options, arm, rng
        self.record = Record()
        self._file = folder / "faults.yaml"
        self._main = PROCESSES if options.processes else ONE
        errors = subprocess.DEVNULL
        self._programs = {
            name: NodeProgram(name, ros.domain, self._words(name), errors)
            for name in (*self._main, "fault_node")
        }
        count = math.ceil(60.0 * options.minutes / options.every)
        faults = [f"{name} {PAUSED}" for name in self._programs] + [f"fault_node {RESTARTED}"]
        if options.processes:
            faults += [f"{name} {KILLED}" for name in ("bounds_node", "controller_node")]
        self._slots = slots(rng, count, tuple(faults))
        self._course: Iterator[None] | None = None
        self._episode: Episode | None = None
        # When the fault node began, by the robot's stamps, s, and the faults since then.
        self._begun_at, self._turn = math.nan, 0
        self._mode, self._stamp, self._first = "", math.nan, math.nan
        self._obeyed_at = math.nan
        self._q = np.full(len(arm.config.joints), np.nan)
        self._goal: tuple[np.ndarray, bool] = self._q, False
        self._goal_open, self._gains_for = False, ""
        self._counted: dict[tuple[str, str, str], int] = {}
        # Read by hand, some times a second: to be called for each state would take a processor.
        self._reader = Node("soak", context=ros.context, start_parameter_services=False)
        self._states = self._reader.create_subscription(
            JointState, f"{BEFORE}joint_states", lambda _: None, CONTROL_QOS
        )
        probe = ros.probe
        self._posture = probe.create_publisher(JointState, "target_posture", GOAL_QOS)
        self._pose = probe.create_publisher(PoseStamped, "target_pose", GOAL_QOS)
        self._wrench = probe.create_publisher(WrenchStamped, "external_wrench", GOAL_QOS)
        self._setter = probe.create_client(SetParameters, "controller_node/set_parameters")
        probe.create_subscription(String, "controller_mode", self._on_mode, LATCHED_QOS)

    def _words(self, name: str) -> list[Any]:
        """Return the arguments of a program."""
        if name == "fault_node":
            return ["--ros-args", "--log-level", "error", "-p", f"faults:={self._file}"]
        words: list[Any] = ["--ros-args", "--log-level", "error", "--params-file"]
        words += [ROOT / "config" / f"{self._options.robot}.yaml", "-p", "clock:=real_time"]
        if self._options.rate is not None:
            words += ["-p", f"rate_hz:={self._options.rate}"]
        told = ", ".join(f"{each:.4f}" for each in self._arm.disturbance)
        words += ["-p", f"bounds_node:acceleration_disturbance:=[{told}]"]
        words += ["-p", f"bullet_node:external_wrench_timeout:={PUSH_TIME}"]
        for topic, kind in SENDERS.items():
            if name in (*ONE, kind.NAME):
                words += ["-r", f"{kind.NAME}:{topic}:={BEFORE}{topic}"]
        return words

    def _on_mode(self, message: String) -> None:
        self._mode = message.data

    # The run

    def run(self, told: Callable[[], bool]) -> None:
        """Go on until the time is over, or until `told` to end."""
        self._file.write_text(timeline(self._slots, self._options.every))
        for program in self._programs.values():
            program.start()
        nodes = {"bullet_node", "bounds_node", "controller_node", "fault_node"}
        self._ros.wait_until(
            lambda: nodes <= set(self._ros.diagnostics) or self._ended() or told(),
            "the programs",
            timeout=START,
        )
        begin = time.monotonic()
        for program in self._programs.values():
            self.record.memory[program.name] = Memory(program.pid, 0.0)
        due = dict.fromkeys(("goal", "sent", "push", "memory", "shown"), 0.0)
        every = {
            "goal": GOAL_TIME,
            "sent": SENT_AGAIN,
            "push": PUSH_EVERY,
            "memory": MEMORY_EVERY,
            "shown": SHOWN if sys.stdout.isatty() else SHOWN_IN_FILE,
        }
        acts = {
            "goal": self._new_goal,
            "sent": self._send_goal,
            "push": self._push,
            "memory": self._look_at_memory,
            "shown": self._show,
        }
        while not told() and self.record.elapsed < 60.0 * self._options.minutes:
            self._spin(LOOK)
            self.record.elapsed = time.monotonic() - begin
            self._look()
            self._suffer()
            if self._ended():
                break
            for name, act in acts.items():
                if self.record.elapsed >= due[name]:
                    due[name] = self.record.elapsed + every[name]
                    act()
        self._finish(told)

    def _finish(self, told: Callable[[], bool]) -> None:
        """Let the last fault end, and take the last reports."""
        open_at = time.monotonic()
        while time.monotonic() - open_at < 5.0 and not self._ended():
            self._spin(LOOK)
            self._look()
            if self._course is not None:
                self._suffer()
            elif self._episode is None or self._episode.over:
                break
        for name in ("bullet_node", "controller_node", "bounds_node"):
            self._ros.diagnostics.pop(name, None)
        waited = time.monotonic()
        while time.monotonic() - waited < 3.0 and "bullet_node" not in self._ros.diagnostics:
            self._spin(LOOK)
        self._look()
        self._look_at_memory()

    def _spin(self, duration: float) -> None:
        end = time.monotonic() + duration
        while (left := end - time.monotonic()) > 0.0:
            self._ros.spin(left)

    def _ended(self) -> bool:
        """Return whether a program has ended by itself, and note which."""
        own = [] if self._course is None else ["fault_node", "bounds_node", "controller_node"]
        found = [n for n, each in self._programs.items() if not each.running and n not in own]
        self.record.ended += [name for name in found if name not in self.record.ended]
        return bool(found)

    # What is seen

    def _look(self) -> None:
        """Take the newest state and reports."""
        while taken := self._states.handle.take_message(JointState, False):
            message = taken[0]
            self._stamp = 1e-9 * stamp_to_ns(message.header.stamp)
            found = dict(zip(message.name, message.position, strict=True))
            self._q = np.array([found[joint] for joint in self._arm.config.joints])
            if math.isnan(self._first):
                self._first = self._stamp
            self.record.played = self._stamp - self._first
        self._take_reports()
        self._look_at_goal()
        for each in self.record.episodes:
            going = self._mode == Mode.TRACKING.value
            if each.again is None and self.record.played >= each.end and going:
                each.again = self.record.played - each.end
            each.obeyed = each.obeyed or self._obeyed_at - self._first >= each.end

    def _take_reports(self) -> None:
        found = self._ros.diagnostics
        if robot := found.get("bullet_node"):
            self.record.note_robot(robot)
            if robot["control"] == "torque":
                self._obeyed_at = 1e-9 * int(robot["stamp_ns"])
        if faults := found.pop("fault_node", None):
            self._begun_at = self._stamp - float(faults["time_s"])
        for node, key in (
            ("bullet_node", "commands_refused"),
            ("controller_node", "states_refused"),
            ("controller_node", "limits_refused"),
            ("controller_node", "goals_refused"),
            ("bounds_node", "states_refused"),
        ):
            text = found.get(node, {}).get(key, "none")
            for part in text.rstrip(";").split("; ") if text != "none" else ():
                why, _, count = part.rpartition(": ")
                known = self.record.refused[node]
                # A node that was started again counts from zero.
                last = self._counted.get((node, key, why), 0)
                known[why] += int(count) - last * (int(count) >= last)
                self._counted[node, key, why] = int(count)

    def _look_at_goal(self) -> None:
        if not self._goal_open or not np.isfinite(self._q).all():
            return
        q, hand = self._goal
        if hand:
            off = pin.log6(self._arm.pose(q).actInv(self._arm.pose(self._q)))
            near = np.linalg.norm(off.linear) < NEAR[1] and np.linalg.norm(off.angular) < NEAR[0]
        else:
            near = bool((np.abs(q - self._q) < NEAR[0]).all())
        if near:
            self._goal_open = False
            self.record.reached[_kind(hand)] += 1

    def close(self) -> None:
        """End all programs."""
        for program in self._programs.values():
            program.end()
        self._reader.destroy_node()

    def _look_at_memory(self) -> None:
        now = self.record.elapsed
        for name, program in self._programs.items():
            if program.running and self.record.memory[name].pid != program.pid:
                self.record.memory[name] = Memory(program.pid, now)
            self.record.memory[name].look(now)

    def _show(self) -> None:
        if sys.stdout.isatty():
            print(f"\r\x1b[K{self.record.line()}", end="", flush=True)
        else:
            print(self.record.line(), flush=True)

    # What is done

    def _new_goal(self) -> None:
        self._goal = self._arm.goal()
        self._goal_open = True
        self.record.given[_kind(self._goal[1])] += 1
        self._send_goal()

    def _send_goal(self) -> None:
        q, hand = self._goal
        if self._gains_for != _kind(hand) and self._setter.service_is_ready():
            self._gains_for = _kind(hand)
            gains = self._arm.config.gains
            own = {name: float(getattr(gains, name)) for name in STIFF}
            values = own if hand else STIFF
            messages = [Parameter(k, value=v).to_parameter_msg() for k, v in values.items()]
            self._setter.call_async(SetParameters.Request(parameters=messages))
        self._pose.publish(pose_message(self._arm.pose(q), self._arm.config.base_frame))
        if not hand:
            self._posture.publish(joint_state(self._arm.config.joints, 0, q))

    def _push(self) -> None:
        message = WrenchStamped()
        message.header.frame_id = self._arm.config.end_effector_frame
        force = message.wrench.force
        force.x, force.y, force.z = self._arm.push().tolist()
        self._wrench.publish(message)
        self.record.pushes += 1

    def _suffer(self) -> None:
        """Begin and go on with faults."""
        if self._course is not None:
            try:
                next(self._course)
            except StopIteration:
                self._course = None
                assert self._episode is not None
                self._episode.end = self.record.played
                self.record.episodes.append(self._episode)
            return
        due = self._begun_at + LEAD + self._turn * self._options.every
        if not self._slots or not self._stamp >= due:  # or the fault node has not begun
            return
        slot = self._slots.pop(0)
        self._turn += 1
        begin = due - self._first
        self._episode = Episode(slot.name, begin, begin + slot.duration)
        if slot.between:
            self.record.episodes.append(self._episode)
        else:
            self._course = self._process_fault(slot)

    def _process_fault(self, slot: Slot) -> Iterator[None]:
        """Do something to a program."""
        name, what = slot.name.split(" ", 1)
        program = self._programs[name]
        if what == PAUSED:
            program.stand_still()
            end = time.monotonic() + slot.duration
            while time.monotonic() < end:
                yield
            program.go_on()
            return
        if what == KILLED:
            program.kill()
        else:
            program.send(signal.SIGTERM)
        while program.running:
            yield
        if name == "fault_node":  # its file begins with the next fault again
            self._file.write_text(timeline(self._slots, self._options.every))
            self._begun_at, self._turn = math.nan, 0
        self._ros.diagnostics.pop(name, None)
        program.start()
        begin = time.monotonic()
        while time.monotonic() - begin < START:
            yield
            if name in self._ros.diagnostics or (name == "fault_node" and self._begun_at > 0.0):
                break
        self._gains_for = ""


def _kind(hand: bool) -> str:
    return "the hand" if hand else "joints"


def main() -> int:
    """Run, print and write the report; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=60.0, help="how long (default: 60)")
    parser.add_argument("--robot", choices=EVERY, default="panda")
    parser.add_argument("--seed", type=int, default=0, help="of goals, pushes and faults")
    parser.add_argument("--processes", action="store_true", help="each node is a process")
    parser.add_argument("--every", type=float, default=8.0, help="s between faults")
    parser.add_argument("--rate", type=float, help="of the control loop, Hz")
    parser.add_argument("--out", type=Path, default=RESULTS / "soak", help="of the report")
    options = parser.parse_args()
    signals: list[int] = []
    for each in (signal.SIGINT, signal.SIGTERM):
        signal.signal(each, lambda number, _: signals.append(number))
    rng = np.random.default_rng(options.seed)
    arm = Arm(options.robot, rng)
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        ros = RosHarness(stack.enter_context(private_domain()))
        stack.callback(ros.close)
        soak = Soak(ros, options, folder, arm, rng)
        stack.callback(soak.close)
        record = soak.record
        record.conditions = (
            f"{options.robot}, {'processes' if options.processes else 'one process'}, "
            f"{options.rate or 1.0 / arm.config.dt:g} Hz, seed {options.seed}, pushes of "
            f"{arm.force:.2g} N, {os.cpu_count()} processors, load at the start "
            f"{' '.join(f'{x:.1f}' for x in os.getloadavg())}"
        )
        print(record.conditions, flush=True)
        try:
            soak.run(lambda: bool(signals))
        except AssertionError as error:
            print(f"error: {error}", file=sys.stderr)
            return 2
    text = record.report()
    print(f"\n{text}")
    try:
        options.out.mkdir(parents=True, exist_ok=True)
        (options.out / "report.md").write_text(text)
        (options.out / "metrics.json").write_text(json.dumps(record.metrics(), indent=2) + "\n")
    except OSError as error:
        print(f"error: no report in {options.out}: {error.strerror}", file=sys.stderr)
        return 2
    print(f"report and metrics are in {options.out}")
    return 1 if record.wrong else 0


if __name__ == "__main__":
    sys.exit(main())
