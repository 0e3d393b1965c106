# SPDX-License-Identifier: Apache-2.0
"""Odd files of all kinds: which program reads them, and what becomes of it."""

from __future__ import annotations

import functools
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import hypothesis
import yaml
from fuzzing import programs
from fuzzing.edit import Edit, exploring
from fuzzing.file_edits import file_edits, odd_file
from fuzzing.messages import Failure, Keep, Show, broken
from fuzzing.tally import TAKEN, ClaimBroken, Tally
from hypothesis import (
    currently_in_test_context,
    given,
    note,
    reproduce_failure,
    seed,
)
from hypothesis import strategies as st

from viability_bounds_pkg.testing.executables import as_child, environment
from viability_bounds_pkg.testing.ros_harness import config_folder

ROBOTS = ("panda", "baxter_left_arm", "talos_left_arm")
KINDS = ("robot", "robot", "robot", "imperfect", "scenario", "faults")
EXAMPLES = 25
"""In a part of the run, which has a seed of its own and can be played again."""
_MODULES = {
    "bounds_node": "viability_bounds_pkg.node.bounds_node",
    "controller_node": "torque_safety_controller.node.controller_node",
    "estimator_node": "viability_bounds_pkg.node.estimator_node",
    "bullet_node": "sim_bridge.nodes.bullet_node",
    "simulated_stack": "sim_bridge.nodes.simulated_stack",
    "safety_stack": "torque_safety_controller.node.safety_stack",
    "fault_node": "sim_bridge.nodes.fault_node",
}
_RUN = (
    "import sys; from viability_bounds_pkg.cli.ros_program import run_program\n"
    "sys.exit(run_program(sys.argv.pop(1)))"
)
"""What an executable does."""
_REALLY = 5
"""Each so many parts, files are read by executables in processes of their own."""
_START = 20.0
"""Within which an executable has started, s."""

CASES = st.tuples(
    st.sampled_from(KINDS),
    st.integers(0, 255),
    st.sampled_from([*programs.NODES, "simulated_stack", *programs.TOOLS]),
    file_edits(),
)
"""Kind of file, which of them, the program that reads it, and changes."""


@functools.cache
def _document(path: Path) -> Any:
    return yaml.safe_load(path.read_text())


def _sources(kind: str, which: int) -> tuple[str, Path]:
    """Return a robot, and the file that is to be changed."""
    folder = config_folder()
    robot = ROBOTS[which % len(ROBOTS)]
    if kind == "robot":
        return robot, folder / f"{robot}.yaml"
    if kind == "imperfect":
        return robot, folder / "imperfect" / f"{robot}.yaml"
    if kind == "scenario":
        every = sorted((folder / "scenarios").glob("*.yaml"))
        path = every[which % len(every)]
        return next(each for each in ROBOTS if path.name.startswith(each)), path
    every = sorted((folder / "faults").glob("*.yaml"))
    return robot, every[which % len(every)]


def command(kind: str, robot: str, program: str, path: Path) -> tuple[str, list[str]]:
    """Return the program that reads a file, and its arguments."""
    own = config_folder() / f"{robot}.yaml"
    if kind == "faults":
        return "fault_node", ["--ros-args", "-p", f"faults:={path}"]
    if kind == "scenario":
        words = ["--ros-args", "--params-file", str(own), "-p", f"scenario:={path}"]
        return "scenario_node", words
    files = [str(path)] if kind == "robot" else [str(own), str(path)]
    if program == "estimate_acceleration_limits":
        words = [files[0], "--samples", "200", "--method", "sampling"]
        return program, words
    words = [word for file in files for word in ("--params-file", file)]
    if program in programs.TOOLS:
        return program, words
    return program, ["--ros-args", *words, "-p", "clock:=lockstep"]


def try_file(
    case: tuple[str, int, str, tuple[Edit, ...]], tally: Tally, *, really: bool = False
) -> None:
    """Start a program with a file that is changed; check what it does.

    Args:
        case: one of `CASES`.
        tally: counts.
        really: start the executable, in a process of its own.
    """
    kind, which, program, changes = case
    robot, source = _sources(kind, which)
    odd = odd_file(_document(source), changes)
    with tempfile.TemporaryDirectory() as folder:
        path = programs.write(odd.data, Path(folder), "odd")
        name, words = command(kind, robot, program, path)
        if really and name not in _MODULES:
            return
        key = f"{kind} file"
        tally.sent[key] += 1
        if currently_in_test_context():
            note(f"{name} {' '.join(words)}\n{odd.data.decode(errors='replace')}")
        ended = _process(name, words) if really else programs.started(name, words, programs.use)
        tally.facts[f"read by {name}" + (", a process" if really else "")] += 1
        # Tools say by their exit code what they found of the robot.
        found = ended.lines[0].startswith(f"{name}: joint ") if ended.lines else True
        if ended.code == 0 or (name in programs.TOOLS and found):
            tally.outcomes[key, TAKEN] += 1
            tally.facts["periods"] += ended.periods
            if ended.lines and name not in programs.TOOLS:
                raise ClaimBroken(f"{name} started, but wrote: {ended.lines}")
            return
        programs.check_refusal(ended, odd.names, (str(path), path.name))
        tally.outcomes[key, _reason(ended.lines[0], str(path))] += 1


def _reason(line: str, path: str) -> str:
    """Return which kind of refusal it is."""
    for words, reason in (
        ("unknown parameter", "unknown parameter"),
        ("is not set", "missing"),
        ("is not below", "not in ros__parameters"),
        ("is for no node", "misspelt section"),
        ("several robots", "several robots"),
        ("items of one type", "list of several types"),
        ("all with a decimal point", "list of several types"),
        ("a second time", "key twice"),
    ):
        if words in line:
            return reason
    if "; allowed: " in line or "parameter '" in line:
        return "value not allowed"
    return "no YAML" if path in line else "else"


def _process(name: str, words: list[str]) -> programs.Ended:
    """Start an executable; end it when it says that it has started."""
    with tempfile.TemporaryFile() as written:
        process = subprocess.Popen(
            [sys.executable, "-c", _RUN, _MODULES[name], *words],
            stdout=subprocess.DEVNULL,
            stderr=written,
            env=environment(),
            preexec_fn=as_child,
        )

        def text_now() -> str:
            return os.pread(written.fileno(), 1 << 20, 0).decode(errors="replace")

        deadline = time.monotonic() + _START
        while process.poll() is None and time.monotonic() < deadline:
            if "subscribes to" in text_now():
                time.sleep(0.2)  # it is on its way into its loop
                process.send_signal(signal.SIGINT)
                break
            time.sleep(0.02)
        try:
            code = process.wait(_START)
        except subprocess.TimeoutExpired:
            process.kill()
            raise ClaimBroken(f"{name} does not end: {text_now()}") from None
        text = text_now()
    lines = [line for line in text.splitlines() if line and not programs.is_log(line)]
    if code < 0:
        raise ClaimBroken(f"{name} was ended by signal {-code}: {text}")
    return programs.Ended(code, lines, 0)


def play(
    number: int,
    tally: Tally,
    *,
    case: bytes | None = None,
    examples: int = EXAMPLES,
    really: bool = False,
) -> Failure | None:
    """Try files of one part of a run; return what broke.

    Args:
        number: seed of this part.
        tally: counts what became of its files.
        case: the only one to try, as a failure has it; None for all.
        examples: how many files.
        really: start executables, in processes of their own.
    """

    @seed(number)
    @exploring(examples)
    @given(CASES)
    def all_files(odd: Any) -> None:
        try_file(odd, tally, really=really)

    if case is not None:
        all_files = reproduce_failure(hypothesis.__version__, case)(all_files)
    return broken(number, all_files)


def fuzz(count: int, first: int, tally: Tally, show: Show, keep: Keep) -> list[Failure]:
    """Try that many odd files; return what broke; arguments as of `messages.fuzz`."""
    failures: list[Failure] = []
    begin, number = time.monotonic(), first
    while (done := sum(tally.sent.values())) < count:
        part = Tally()
        really = number % _REALLY == 0
        examples = 2 if really else min(EXAMPLES, count - done)
        if failure := play(number, part, examples=examples, really=really):
            failures.append(failure)
            keep(failure)
        tally.add(part)
        number += 1
        done = sum(tally.sent.values())
        rate = (time.monotonic() - begin) / max(1, done)
        show(
            f"\rpart {number}, files: {done} of {count}, {1e3 * rate:.0f} ms each, "
            f"{len(failures)} parts broke "
        )
    return failures
