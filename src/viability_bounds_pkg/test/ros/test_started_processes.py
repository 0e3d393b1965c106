# SPDX-License-Identifier: Apache-2.0
"""Processes that tests start end with them."""

import os
import select
import signal
import subprocess
import sys

import pytest

from viability_bounds_pkg.testing.executables import as_child, environment, run_to_end

STARTS_ANOTHER = """
import subprocess, sys
from functools import partial
from signal import Signals
from viability_bounds_pkg.testing.executables import as_child

wait = "import sys, time; print('there', flush=True); time.sleep(600)"
ended_by = partial(as_child, Signals[sys.argv[1]])
subprocess.Popen([sys.executable, "-c", wait], preexec_fn=ended_by).wait()
"""


@pytest.mark.parametrize("by", ["SIGTERM", "SIGKILL"])
def test_what_a_test_starts_ends_with_it_when_it_is_killed(by):
    with subprocess.Popen(
        [sys.executable, "-c", STARTS_ANOTHER, by],
        env=environment(),
        stdout=subprocess.PIPE,
        text=True,
        preexec_fn=as_child,
    ) as test:
        assert test.stdout.readline() == "there\n"
        test.send_signal(signal.SIGKILL)
        # The pipe ends when the other one has ended, too.
        assert test.communicate(timeout=30.0) == ("", None)


def test_a_program_that_takes_too_long_ends_with_what_it_has_started(tmp_path):
    child = tmp_path / "child"
    with pytest.raises(subprocess.TimeoutExpired):
        run_to_end("bash", "-c", f"sleep 100 & echo $! > {child}; wait", timeout=1.0)
    try:
        handle = os.pidfd_open(int(child.read_text()))
    except ProcessLookupError:
        return
    assert select.select([handle], [], [], 5.0)[0], "it goes on"
    os.close(handle)
