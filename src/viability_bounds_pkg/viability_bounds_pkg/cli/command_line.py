# SPDX-License-Identifier: Apache-2.0
"""Shared by command line tools: errors and interrupts in one line, exit codes, progress."""

from __future__ import annotations

import argparse
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NoReturn

from viability_bounds_pkg.exceptions import ArmSafetyError, did_you_mean

INTERRUPTED = 130
"""Exit code of a program ended by SIGINT, as shells report it."""


class Parser(argparse.ArgumentParser):
    """Reports a usage error in one line."""

    def add_parameter_files(self) -> None:
        """Add the option by which tools get parameter files, as nodes do: `params_file`."""
        self.add_argument(
            "--params-file",
            type=Path,
            action="append",
            required=True,
            metavar="FILE",
            help="parameter file of the robot (ROS 2 YAML); repeatable, the last value given "
            "counts",
        )

    def error(self, message: str) -> NoReturn:
        """Print what is wrong, and exit with 2."""
        kind, _, words = message.partition(": ")
        hint = ""
        if kind == "unrecognized arguments":
            word = words.split()[0]
            known = [each for each in self._option_string_actions if each.startswith("--")]
            of_ros = word in ("-p", "-r", "--params-file", "--log-level")
            hint = "; arguments for ROS follow --ros-args" if of_ros else did_you_mean(word, known)
        self.exit(2, f"{self.prog}: error: {message}{hint}\n")


def positive(text: str) -> float:
    """Return an argument that must be a finite number above 0."""
    value = number(text)
    if not 0.0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"must be positive, is {text}")
    return value


def number(text: str) -> float:
    """Return an argument that must be a number."""
    try:
        return float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"must be a number, is '{text}'") from None


def run_tool(name: str, tool: Callable[[], int]) -> int:
    """Run a tool; return its exit code: its own, 1 for an error, 130 for an interrupt.

    Args:
        name: of the tool.
        tool: returns its exit code.
    """
    try:
        return tool()
    except (ArmSafetyError, OSError) as error:
        for line in str(error).splitlines():  # one for each of several mistakes
            print(f"{name}: {line}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print(f"{name}: interrupted, nothing written", file=sys.stderr)
        return INTERRUPTED


@contextmanager
def stage(name: str) -> Iterator[None]:
    """Tell on stderr what is done, on a terminal with its seconds."""
    done, begin = threading.Event(), time.monotonic()

    def tell() -> None:
        while not done.wait(1.0):
            seconds = time.monotonic() - begin
            print(f"\r{name}: {seconds:.0f} s", end="", file=sys.stderr, flush=True)

    if not sys.stderr.isatty():
        print(f"{name} ...", file=sys.stderr, flush=True)
        yield
        return
    thread = threading.Thread(target=tell, daemon=True)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()
        print("\r\033[K", end="", file=sys.stderr, flush=True)
