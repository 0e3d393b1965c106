# SPDX-License-Identifier: Apache-2.0
"""The scenario node: plays a scenario over topics and services, and records the run."""

from __future__ import annotations

import math
import signal
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import rclpy
from rclpy.executors import Executor, ExternalShutdownException
from rclpy.task import Future

from sim_bridge.mcap_file import McapFile
from sim_bridge.node.progress import Progress
from sim_bridge.node.run_recorder import RunRecorder
from sim_bridge.node.scenario_messages import (
    PAUSES,
    RESET,
    ScenarioRefused,
    ScheduledCalls,
    ScheduledPublisher,
    change_parameters,
    pause,
    to_controller,
    to_robot,
)
from sim_bridge.scenario.report import RecordedRun, write_report
from sim_bridge.scenario.scenario import ScenarioConfiguration
from viability_bounds_pkg.cli.command_line import INTERRUPTED
from viability_bounds_pkg.ros.arm_node import ArmNode
from viability_bounds_pkg.ros.parameters import NodeParameters
from viability_bounds_pkg.ros.program import (
    initialise,
    leave,
    node_parser,
    report_refusal,
    time_to_leave,
)
from viability_bounds_pkg.ros.runtime import make_executor, steady_timer

_POLL_PERIOD = 0.02
_SHOW_PERIOD = 0.5
_LEAD = 1.0
"""Time before the first goal on a robot that cannot pause: its messages arrive meanwhile, s."""


class ScenarioNode(ArmNode):
    """Resets a paused robot, plays a scenario on it, and records the run.

    A robot whose diagnostics tell nothing of pauses is neither reset nor paused. Goals, pushes and
    obstacles are sent before their time with the stamps at which they take effect. In lockstep the
    robot is paused where a service must be called, until it has answered; so a run in lockstep is
    the same each time.

    Args:
        file: to which all messages go as they come; None for none.

    Attributes:
        awaits: what it waits for.
        ended: done when the scenario has ended.
        failure: why it ended early; None if it did not.
        recorder: the recorded messages and diagnostics of the other nodes.
    """

    NAME = "scenario_node"
    PARAMETERS = ScenarioConfiguration

    def __init__(self, *, file: McapFile | None = None, **node_arguments: Any) -> None:
        super().__init__(**node_arguments)
        with self.starting():
            config = NodeParameters(self, ScenarioConfiguration).configuration
        self.config = config
        self.awaits = ""
        self.ended: Future[None] = Future()
        self.failure: ScenarioRefused | None = None
        self.recorder = RunRecorder(
            self, config.joints, config.continuous, file, config.robot_node
        )
        self._first, self._period = 0, 1
        self._refused: dict[str, list[str]] | None = None  # when the messages begin; else None
        frames = config.base_frame, config.end_effectors[0]
        self._goals = ScheduledPublisher(
            self, "controller_node", to_controller(config.plan, *frames)
        )
        self._world = ScheduledPublisher(
            self, config.robot_node, to_robot(config.plan, config.base_frame)
        )
        self._calls = ScheduledCalls(self, config.plan, PAUSES)
        self._course = self._play()
        steady_timer(self, _POLL_PERIOD, self._proceed)

    @property
    def robot(self) -> dict[str, str]:
        """The robot's last diagnostics, by key."""
        return self.recorder.diagnostics[self.config.robot_node]

    @property
    def reached(self) -> tuple[str, int]:
        """What it waits for, and how far robot time is, which counts once the scenario began."""
        return self.awaits, -1 if self._refused is None else self.recorder.stamp

    @property
    def _pauses(self) -> bool:
        """Whether the robot can be reset and paused."""
        return "paused" in self.robot or not self.robot

    @property
    def _duration(self) -> int:
        """Control periods that the scenario lasts."""
        return round(1e9 * self.config.plan.duration / self._period)

    def recorded_run(self) -> RecordedRun:
        """Return the recording since the robot began to move."""
        played = int(self.robot["periods"]) if self._pauses else self._duration
        return self.recorder.run(self._first, self._period, played)

    # Course of the scenario

    def _proceed(self) -> None:
        try:
            if self.failure is None:
                self._check_publishers()
            if self.failure is None and self._refused is not None:
                self._check_refusals(self._refused)
            self.awaits = next(self._course)
        except StopIteration:
            self.ended.set_result(None)
        except ScenarioRefused as error:
            self.failure, self._course = error, self._stop()

    def _play(self) -> Iterator[str]:
        """Play the scenario; yield what must happen before it proceeds."""
        while missing := self._missing():
            yield f"getting ready: there is no {', no '.join(missing)}"
        if not self._pauses:
            yield from self._play_through()
            return
        before = self._first = self.recorder.stamp
        yield from self._calls.call(RESET)
        while not self.recorder.answered == self.recorder.stamp > before:
            yield "resetting: there is no joint command for the start"
        # Resuming begins a new period: the first state in motion is the next.
        self._begin(1)
        while not self._load():
            yield "loading: there is no report that the messages of the scenario were received"
        lockstep = self.robot["clock"] == "lockstep"
        begin, end = 0, self._duration
        while begin < end:
            yield from self._calls.call_due(begin, self._period)
            # In lockstep the robot pauses where a service is due.
            halt = min(end, self._calls.next_period(self._period) or end) if lockstep else end
            left = 1e-9 * self._period * (halt - begin)
            yield from self._calls.call(change_parameters("bullet_node", {"pause_after": left}))
            yield from self._calls.call(pause(False))
            while not self._is_paused_at(halt):
                if not lockstep:
                    now = (self.recorder.stamp - self._first) // self._period
                    yield from self._calls.call_due(now, self._period)
                yield "playing"
            begin = halt

    def _play_through(self) -> Iterator[str]:
        """Play on a robot that goes on by itself; its messages are sent before the first goal."""
        lead = round(_LEAD / float(self.robot["period_s"]))
        self._begin(lead)
        loaded, now = False, -lead
        while now < self._duration:
            loaded = loaded or self._load()
            yield from self._calls.call_due(now, self._period)
            yield "playing"
            now = (self.recorder.stamp - self._first) // self._period

    def _begin(self, lead: int) -> None:
        """Let the scenario start `lead` periods from now; refusals of before do not count."""
        self._period = round(1e9 * float(self.robot["period_s"]))
        self._first = self.recorder.stamp + lead * self._period
        self._refused = {}
        self._check_refusals(self._refused)

    def _stop(self) -> Iterator[str]:
        """Pause the robot if the scenario has begun and it can, and end."""
        if self._refused is not None and self._pauses:
            yield from self._calls.call(pause(True))

    def _missing(self) -> list[str]:
        """Return what is missing before the scenario can begin."""
        unused = () if self._pauses else PAUSES
        topics = self._goals.without_subscriber() + self._world.without_subscriber()
        return (
            (["paused robot"] if self._pauses and self.robot.get("paused") != "True" else [])
            + ([] if self.recorder.stamp >= 0 else ["joint states"])
            + ([] if self.recorder.answered >= 0 else ["joint commands"])
            + [f"service {name}" for name in self._calls.without_server(unused)]
            + [f"subscriber of {topic}" for topic in topics]
        )

    def _load(self) -> bool:
        """Send scheduled messages; return whether all were received."""
        goals = self.recorder.diagnostics["controller_node"].get("goals_pending", 0)
        loaded = self._goals.proceed(self._first, int(goals))
        changes = int(self.robot["world_changes_pending"])
        return self._world.proceed(self._first, changes) and loaded

    def _is_paused_at(self, halt: int) -> bool:
        """Return whether the robot reports that it has paused where period `halt` begins."""
        last = self._first + (halt - 1) * self._period
        return int(self.robot["stamp_ns"]) >= last and self.robot["paused"] == "True"

    def _check_publishers(self) -> None:
        """Refuse to record what several robots, bounds nodes or controllers publish."""
        if trouble := self.publisher_watch.trouble:
            raise ScenarioRefused(f"{trouble}; allowed: one")

    def _check_refusals(self, known: dict[str, list[str]]) -> None:
        # By node: the key of diagnostics that counts refusals by topic, and a scenario's topics.
        for node, key, topics in (
            ("controller_node", "goals_refused", "target_"),
            (self.config.robot_node, "commands_refused", ("external_wrench", "obstacles")),
        ):
            counts = self.recorder.diagnostics[node].get(key, "").split("; ")
            refused = [count for count in counts if count.startswith(topics)]
            if refused != known.setdefault(node, refused):
                raise ScenarioRefused(f"refused by {node}: {' '.join(refused)}")

    # Output

    def show(self, progress: Progress) -> None:
        """Show the state of the run."""
        if self._refused is None:
            progress.wait(self.awaits)
            return
        # With the period that the last state begins.
        played = 1e-9 * (self.recorder.stamp - self._first + self._period)
        progress.show(max(0.0, played))


def play(
    node: ScenarioNode,
    others: Sequence[ArmNode] = (),
    *,
    signals: Sequence[int] = (),
    quiet: bool = False,
) -> None:
    """Run the scenario to its end and print its state.

    Args:
        node: the scenario.
        others: nodes to run in the same process.
        signals: received so far; one more ends the run early.
        quiet: print nothing.

    Raises:
        TimeoutError: the other nodes did not start, or stopped answering.
        ScenarioRefused: another node refused a message or call of the scenario.
        ExternalShutdownException: shut down, or a signal received, before the end.
    """
    executor = make_executor(node.context)
    try:
        for each in (node, *others):
            executor.add_node(each)
        _run(executor, node, signals, quiet)
    finally:
        # An error that is kept keeps this frame, and so the executor. One that is not shut down
        # holds the nodes in C++: destroyed, they would stay in the graph and go on publishing.
        executor.shutdown()
    if node.failure is not None:
        raise node.failure
    if not node.ended.done():
        raise ExternalShutdownException


def _run(executor: Executor, node: ScenarioNode, signals: Sequence[int], quiet: bool) -> None:
    """Run callbacks until the scenario has ended, one is to end it, or nothing moves any more."""
    seen, moved_at, shown_at = None, time.monotonic(), -math.inf
    progress = None if quiet else Progress(node.config, node.recorder)
    while not (node.ended.done() or signals) and rclpy.ok(context=node.context):
        # Many callbacks in a call: a tenth of the time of a period in lockstep would go into
        # calls for one each.
        executor.spin_until_future_complete(node.ended, timeout_sec=0.1)
        now = time.monotonic()
        if node.reached != seen:
            seen, moved_at = node.reached, now
        elif now - moved_at > node.config.ready_timeout:
            raise TimeoutError(
                f"nothing has moved for {node.config.ready_timeout:g} s ({node.awaits})"
            )
        if progress and (node.ended.done() or now - shown_at > _SHOW_PERIOD):
            shown_at = now
            node.show(progress)


def main(args: list[str] | None = None) -> int:
    """Play a scenario; with ``--out DIRECTORY`` also write its report.

    Returns:
        0 when no limit was broken, 1 when one was, 2 when the scenario could not be played.
    """
    node, file = None, None
    try:
        try:
            parser = node_parser(ScenarioNode)
            parser.add_argument("--out", type=Path, metavar="DIRECTORY", help="of the report")
            parser.add_argument(
                "--record", type=Path, metavar="FILE", help="all messages, as MCAP"
            )
            options = initialise(parser, args)
            # An exception in a callback is more than the executor reports in one line.
            signals: list[int] = []
            for each in (signal.SIGINT, signal.SIGTERM):
                signal.signal(each, lambda number, _: signals.append(number))
            if options.record is not None:
                options.record.parent.mkdir(parents=True, exist_ok=True)
                file = McapFile(options.record)
            node = ScenarioNode(file=file)
        except Exception as error:
            report_refusal(error)
            return 2
        play(node, signals=signals)
        for each in (signal.SIGINT, signal.SIGTERM):
            signal.signal(each, signal.default_int_handler)
        if options.out is None:
            return 0
        diagnostics = node.recorder.diagnostics
        kept = write_report(options.out, node.config, node.recorded_run(), diagnostics)
        return 0 if kept else 1
    except (TimeoutError, ScenarioRefused, OSError) as error:
        report_refusal(error)
        return 2
    except (KeyboardInterrupt, ExternalShutdownException):
        return INTERRUPTED
    finally:
        with time_to_leave():
            leave(*filter(None, [node]))
        if file is not None:
            file.close()


if __name__ == "__main__":
    sys.exit(main())
