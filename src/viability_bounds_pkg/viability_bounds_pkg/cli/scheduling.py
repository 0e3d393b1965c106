# SPDX-License-Identifier: Apache-2.0
"""What a program asks of Linux to keep its time: priority, memory, processors."""

from __future__ import annotations

import argparse
import ctypes
import os
import resource
from collections.abc import Callable
from pathlib import Path

_MCL_CURRENT, _MCL_FUTURE = 1, 2  # sys/mman.h


def add_scheduling(parser: argparse.ArgumentParser) -> None:
    """Add the options `priority`, `lock_memory` and `cpus`, all off by default."""
    parser.add_argument(
        "--priority",
        type=_priority,
        metavar="N",
        help="real-time priority (SCHED_FIFO) of all threads, 1 to 99",
    )
    parser.add_argument(
        "--lock-memory", action="store_true", help="keep the memory from being paged out"
    )
    parser.add_argument(
        "--cpus", type=_cpus, metavar="LIST", help="processors to run on, as in 0,2"
    )


def schedule(options: argparse.Namespace) -> tuple[list[str], list[str]]:
    """Ask the system for what the options say, for all threads that there are.

    Threads that they start later inherit it.

    Returns:
        What was granted, and what was refused and why, a line each.
    """
    granted: list[str] = []
    refused: list[str] = []

    def ask(what: str, call: Callable[[], None], limit: str) -> None:
        try:
            call()
            granted.append(f"{what} granted")
        except OSError as error:
            refused.append(f"{what} refused: {error.strerror}, {limit}")

    if options.priority is not None:
        limit = f"ulimit -r is {resource.getrlimit(resource.RLIMIT_RTPRIO)[0]}"
        ask(f"priority {options.priority}", lambda: _prefer(options.priority), limit)
    if options.lock_memory:
        size = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]
        limit = f"ulimit -l is {'unlimited' if size < 0 else size // 1024}"
        ask("locked memory", _lock_memory, limit)
    if options.cpus:
        name = f"processors {','.join(map(str, sorted(options.cpus)))}"
        ask(name, lambda: _pin(options.cpus), f"there are {os.cpu_count()}")
    return granted, refused


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
    if not (text.isdecimal() and 1 <= int(text) <= 99):
        raise argparse.ArgumentTypeError(f"must be a whole number from 1 to 99, is '{text}'")
    return int(text)


def _cpus(text: str) -> frozenset[int]:
    if not all(part.isdecimal() for part in text.split(",")):
        allowed = f"must be numbers of processors, as in 0,2, is '{text}'"
        raise argparse.ArgumentTypeError(allowed)
    return frozenset(map(int, text.split(",")))
