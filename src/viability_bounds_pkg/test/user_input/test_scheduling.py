# SPDX-License-Identifier: Apache-2.0
"""What a program asks of the system to keep its time, and what it says came of it."""

import os
import subprocess
import sys

import pytest

from viability_bounds_pkg.cli.command_line import Parser
from viability_bounds_pkg.cli.scheduling import add_scheduling, schedule

PROGRAM = """
import os, sys, threading
from viability_bounds_pkg.cli.scheduling import schedule
from argparse import Namespace
threading.Thread(target=threading.Event().wait, daemon=True).start()
cpu = int(sys.argv[1])
granted, refused = schedule(Namespace(priority=None, lock_memory=False, cpus=frozenset({cpu})))
tasks = os.listdir('/proc/self/task')
assert len(tasks) > 1
for task in tasks:
    assert os.sched_getaffinity(int(task)) == {cpu}, task
print(*granted, *refused)
"""


def options(*words):
    parser = Parser(prog="node")
    add_scheduling(parser)
    return parser.parse_args(words)


def test_nothing_is_asked_for_by_default(monkeypatch):
    for name in ("sched_setscheduler", "sched_setaffinity"):
        monkeypatch.setattr(os, name, lambda *_: pytest.fail("it asked"))
    assert schedule(options()) == ([], [])


def test_all_threads_get_what_is_asked_for():
    here = min(os.sched_getaffinity(0))
    said = subprocess.run(
        [sys.executable, "-c", PROGRAM, str(here)], capture_output=True, text=True, check=True
    )
    assert said.stdout == f"processors {here} granted\n"


def test_what_is_refused_is_said_with_the_reason_and_the_rest_is_granted(monkeypatch):
    def refuse(*_):
        raise PermissionError(1, "Operation not permitted")

    pinned = []
    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    monkeypatch.setattr(os, "sched_setaffinity", lambda _, cpus: pinned.append(cpus))
    granted, (refused,) = schedule(options("--priority", "80", "--cpus", "0,1"))
    assert granted == ["processors 0,1 granted"]
    assert pinned[0] == {0, 1}
    assert refused.startswith("priority 80 refused: Operation not permitted, ulimit -r is ")


@pytest.mark.parametrize(
    ("words", "shown"),
    [
        (
            ("--priority", "100"),
            "argument --priority: must be a whole number from 1 to 99, is",
        ),
        (("--priority", "high"), "from 1 to 99, is 'high'"),
        (("--cpus", "0-1"), "argument --cpus: must be numbers of processors, as in 0,2, is '0-1'"),
    ],
)
def test_options_that_mean_nothing_are_refused(capsys, words, shown):
    with pytest.raises(SystemExit) as end:
        options(*words)
    assert end.value.code == 2
    assert shown in capsys.readouterr().err
