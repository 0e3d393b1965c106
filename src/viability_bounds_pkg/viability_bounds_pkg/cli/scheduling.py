# SPDX-License-Identifier: Apache-2.0
"""What a program asks of Linux to keep its time: priority, memory, processors."""

from __future__ import annotations

import argparse
import ctypes
import os
import resource
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

HIGHEST = 99
"""Of the priorities of SCHED_FIFO."""

_MCL_CURRENT, _MCL_FUTURE = 1, 2  # sys/mman.h


class Outcome(NamedTuple):
    """What the system made of a request.

    Attributes:
        text: one line; empty if nothing was asked for.
        granted: whether it granted all.
    """

    text: str
    granted: bool


def add_scheduling(parser: argparse.ArgumentParser) -> None:
    """Add the options `priority`, `lock_memory` and `cpus`, all off by default."""
    parser.add_argument(
        "--priority",
        type=_priority,
        metavar="N",
        help=f"real-time priority (SCHED_FIFO) of all threads, 1 to {HIGHEST}",
    )
    parser.add_argument(
        "--lock-memory",
        action="store_true",
        help="keep the memory from being paged out",
    )
    parser.add_argument(
        "--cpus", type=_cpus, metavar="LIST", help="processors to run on, as in 0,2"
    )


def schedule(options: argparse.Namespace) -> Outcome:
    """Ask the system for what the options say, for all threads that there are.

    Threads that they start later inherit it.
    """
    asked: list[tuple[str, Callable[[], None], str]] = []
    if options.priority is not None:
        limit = f"ulimit -r is {resource.getrlimit(resource.RLIMIT_RTPRIO)[0]}"
        asked.append((f"priority {options.priority}", lambda: _prefer(options.priority), limit))
    if options.lock_memory:
        most = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]
        limit = f"ulimit -l is {'unlimited' if most < 0 else most // 1024}"
        asked.append(("locked memory", _lock_memory, limit))
    if options.cpus:
        there = f"there are {','.join(map(str, range(os.cpu_count() or 1)))}"
        name = f"processors {','.join(map(str, sorted(options.cpus)))}"
        asked.append((name, lambda: _pin(options.cpus), there))
    said, granted = [], True
    for name, ask, limit in asked:
        try:
            ask()
            said.append(f"{name} granted")
        except OSError as error:
            granted = False
            said.append(f"{name} refused: {error.strerror}, {limit}")
    return Outcome(f"scheduling: {'; '.join(said)}" if said else "", granted)


def _threads() -> list[int]:
    return [int(task.name) for task in Path("/proc/self/task").iterdir()]


def _prefer(priority: int) -> None:
    for thread in _threads():
        os.sched_setscheduler(thread, os.SCHED_FIFO, os.sched_param(priority))


def _lock_memory() -> None:
    if ctypes.CDLL(None, use_errno=True).mlockall(_MCL_CURRENT | _MCL_FUTURE):
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))


def _pin(cpus: frozenset[int]) -> None:
    for thread in _threads():
        os.sched_setaffinity(thread, cpus)


def _priority(text: str) -> int:
    if not (text.isdecimal() and 1 <= int(text) <= HIGHEST):
        allowed = f"must be a whole number from 1 to {HIGHEST}, is '{text}'"
        raise argparse.ArgumentTypeError(allowed)
    return int(text)


def _cpus(text: str) -> frozenset[int]:
    if not all(part.isdecimal() for part in text.split(",")):
        allowed = f"must be numbers of processors, as in 0,2, is '{text}'"
        raise argparse.ArgumentTypeError(allowed)
    return frozenset(map(int, text.split(",")))
