# SPDX-License-Identifier: Apache-2.0
"""Programs of nodes as processes that are killed, stopped and started again."""

from __future__ import annotations

import os
import resource
import signal
import subprocess
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import IO, Any

from ament_index_python.packages import get_package_prefix

from viability_bounds_pkg.testing.executables import as_child

PACKAGES = {
    "bounds_node": "viability_bounds_pkg",
    "estimator_node": "viability_bounds_pkg",
    "controller_node": "torque_safety_controller",
    "safety_stack": "torque_safety_controller",
    "bullet_node": "sim_bridge",
    "scenario_node": "sim_bridge",
    "simulated_stack": "sim_bridge",
}
_END = 15.0  # s, after which a program that was told to end is killed


class NodeProgram:
    """A program, each time it is started in a process of its own.

    Args:
        name: of the executable, one of `PACKAGES` unless `start` is given.
        domain: ROS domain.
        words: arguments, those for ROS with their ``--ros-args``.
        errors: where its stderr goes, as for `subprocess`.
        start: words that start it, before its arguments; None for the installed executable.

    Attributes:
        name: as given.
        process: the last one; None before the first start.
    """

    def __init__(
        self,
        name: str,
        domain: int,
        words: Sequence[Any],
        errors: int | IO[Any] | None = None,
        start: Sequence[str] | None = None,
    ) -> None:
        if start is None:
            folder = Path(get_package_prefix(PACKAGES[name])) / "lib" / PACKAGES[name]
            start = [str(folder / name)]
        self.name = name
        self._words = [*start, *map(str, words)]
        self._environment = os.environ | {"ROS_DOMAIN_ID": str(domain)}
        self._errors = errors
        self.process: subprocess.Popen[str] | None = None

    @property
    def running(self) -> bool:
        """Whether it has been started and has not ended."""
        return self.process is not None and self.process.poll() is None

    @property
    def pid(self) -> int:
        """Of the last process."""
        assert self.process is not None, f"{self.name} was not started"
        return self.process.pid

    def start(self) -> None:
        """Start it; it must not run."""
        assert not self.running, f"{self.name} runs"
        self.process = subprocess.Popen(
            self._words,
            env=self._environment,
            stderr=self._errors,
            text=True,
            preexec_fn=partial(as_child, signal.SIGKILL),  # it may stand still
        )

    def send(self, number: signal.Signals) -> None:
        """Send it a signal."""
        assert self.process is not None, f"{self.name} was not started"
        self.process.send_signal(number)

    def stand_still(self) -> None:
        """Let it compute nothing until `go_on`."""
        self.send(signal.SIGSTOP)

    def go_on(self) -> None:
        """Let it compute again."""
        self.send(signal.SIGCONT)

    def kill(self) -> None:
        """End it at once, as the system does when there is no memory."""
        self._wait(signal.SIGKILL)

    def end(self) -> None:
        """Tell it to end, and wait."""
        if self.running:
            self.go_on()
            self._wait(signal.SIGTERM)

    def fill_disk(self) -> None:
        """Let all that it writes to files from now on fail, as on a full disk.

        The limit is on the size of files: `EFBIG` comes where a full disk gives `ENOSPC`.
        """
        resource.prlimit(self.pid, resource.RLIMIT_FSIZE, (0, resource.RLIM_INFINITY))

    def empty_disk(self) -> None:
        """Let it write again."""
        unlimited = resource.RLIM_INFINITY, resource.RLIM_INFINITY
        resource.prlimit(self.pid, resource.RLIMIT_FSIZE, unlimited)

    def _wait(self, number: signal.Signals) -> None:
        assert self.process is not None, f"{self.name} was not started"
        self.send(number)
        try:
            self.process.wait(_END)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
