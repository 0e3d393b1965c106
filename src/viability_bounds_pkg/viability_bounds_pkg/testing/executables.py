# SPDX-License-Identifier: Apache-2.0
"""Executables for tests: as users start them, and in this process, which is faster."""

from __future__ import annotations

import ctypes
import os
import resource
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

import pytest

TIME_LIMIT = 60.0
"""For a process, s."""

_LIBC = ctypes.CDLL(None)
_PR_SET_PDEATHSIG = 1  # of Linux


def environment() -> dict[str, str]:
    """Return the environment of a process that imports what this one imports."""
    return os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}


@contextmanager
def room_on_disk(size: int) -> Iterator[None]:
    """Let what this process writes to a file beyond so many bytes fail, as on a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def as_child(end: signal.Signals = signal.SIGTERM) -> None:
    """Let SIGINT end the process to be started, and the end of this one, also when it is killed.

    In the background SIGINT is ignored by inheritance.

    Args:
        end: signal that the process gets when this one has ended.
    """
    signal.signal(signal.SIGINT, signal.default_int_handler)
    _LIBC.prctl(_PR_SET_PDEATHSIG, end)


def run_to_end(
    *command: Any, timeout: float | None = 120.0, **options: Any
) -> subprocess.CompletedProcess[str]:
    """Return how a program ended and what it said.

    Args:
        command: its words.
        timeout: the longest that it may take, s.
        options: others of `subprocess.Popen`.
    """
    words = list(map(str, command))
    with subprocess.Popen(
        words,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        **options,
    ) as program:
        try:
            said = program.communicate(timeout=timeout)
        except BaseException:
            with suppress(ProcessLookupError):
                os.killpg(program.pid, signal.SIGKILL)  # with what it has started
            raise
    return subprocess.CompletedProcess(words, program.returncode, *said)


def started(*arguments: Any) -> subprocess.CompletedProcess[str]:
    """Return how Python ended that was started with arguments such as ``-m module``."""
    return run_to_end(
        sys.executable,
        *arguments,
        env=environment(),
        timeout=TIME_LIMIT,
        preexec_fn=as_child,
    )


def called(
    capfd: pytest.CaptureFixture[str], main: Callable[..., int], *arguments: Any
) -> subprocess.CompletedProcess[str]:
    """Return how an executable's `main` ended in this process."""
    try:
        code: Any = main([str(argument) for argument in arguments])
    except SystemExit as ended:
        code = ended.code
    return subprocess.CompletedProcess(arguments, code, *capfd.readouterr())
