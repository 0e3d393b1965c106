# SPDX-License-Identifier: Apache-2.0
"""The estimate_acceleration_limits executable, interrupted."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading

from viability_bounds_pkg.testing.executables import (
    TIME_LIMIT,
    as_child,
    environment,
)
from viability_bounds_pkg.testing.two_joint_robot import parameters_in


def interrupt_when(process, ready):
    """Send SIGINT once `ready()` of a line of output says so, or the time is up."""
    timer = threading.Timer(TIME_LIMIT, process.kill)
    timer.start()
    lines = []
    for line in process.stdout:
        lines.append(line)
        if ready(line):
            process.send_signal(signal.SIGINT)
            break
    rest, errors = process.communicate()
    timer.cancel()
    return "".join(lines) + rest, errors


def start(code, *arguments):
    return subprocess.Popen(
        [sys.executable, "-c", code, *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment(),
        preexec_fn=as_child,
    )


# Says when the search has found something: a marker to wait for instead of a time.
ANNOUNCED_SEARCH = """
import sys
from viability_bounds_pkg.cli import estimate_acceleration_limits as tool
search = tool.SEARCHES["sampling"]
def announced(*arguments):
    for count, worst in enumerate(search(*arguments)):
        if count == 3:
            print("SEARCHING", flush=True)
        yield worst
tool.SEARCHES["sampling"] = announced
sys.exit(tool.main())
"""


def test_interrupt_keeps_what_was_found(write_robot, tmp_path):
    output = tmp_path / "limits.yaml"
    samples = 10**9  # hours
    process = start(
        ANNOUNCED_SEARCH, write_robot(), "-o", output, "--method", "sampling", "--samples", samples
    )
    out, errors = interrupt_when(process, lambda line: "SEARCHING" in line)
    assert process.returncode == 130, errors
    assert f"of {samples} evaluations: the limits are those found so far" in errors
    assert "Traceback" not in errors
    assert "shoulder: torque leaves" in out
    text = output.read_text()
    assert "INTERRUPTED" in text
    written = parameters_in(text)
    assert max(written["acceleration_min"]) < 0.0 < min(written["acceleration_max"])


def test_interrupt_in_the_margin_keeps_the_limits(write_robot, tmp_path):
    output = tmp_path / "limits.yaml"
    slow = ANNOUNCED_SEARCH.replace(
        "sys.exit",
        "import functools\ntool.discretisation_margin = functools.partial("
        "tool.discretisation_margin, samples=10**6, starts=10**4, rounds=10**4)\nsys.exit",
    )
    process = start(slow, write_robot(), "-o", output, "--samples", 500, "--margin-dt", 0.01)
    _, errors = interrupt_when(process, lambda line: "drift of a held torque" in line)
    assert process.returncode == 130, errors
    assert "acceleration_drift is left out" in errors
    assert set(parameters_in(output.read_text())) == {"acceleration_min", "acceleration_max"}


def test_interrupt_before_anything_was_found(write_robot, tmp_path):
    output = tmp_path / "limits.yaml"
    output.write_text("old")
    code = (
        "import sys\nfrom viability_bounds_pkg.cli import estimate_acceleration_limits as tool\n"
        "def wait(path):\n    print('READING', flush=True)\n    while True:\n        pass\n"
        "tool.read_robot = wait\nsys.exit(tool.main())\n"
    )
    process = start(code, write_robot(), "-o", output)
    _, errors = interrupt_when(process, lambda line: "READING" in line)
    assert process.returncode == 130
    assert "nothing written" in errors
    assert output.read_text() == "old"
