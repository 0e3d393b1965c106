# SPDX-License-Identifier: Apache-2.0
"""Processes that tests start end with them."""

import signal
import subprocess
import sys

import pytest

from viability_bounds_pkg.testing.executables import as_child, environment

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
