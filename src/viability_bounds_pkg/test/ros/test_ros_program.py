# SPDX-License-Identifier: Apache-2.0
"""Entry points: what they import may be interrupted."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

import viability_bounds_pkg
from viability_bounds_pkg.testing.executables import as_child, run_to_end

PACKAGES = str(Path(viability_bounds_pkg.__file__).resolve().parents[1])
INTERRUPT = "import os, signal\nos.kill(os.getpid(), signal.SIGINT)\n"
CALL = (
    "import sys; from viability_bounds_pkg.cli.ros_program import run_program; "
    "sys.exit(run_program('slow_program'))"
)


def call(directory, program):
    (directory / "slow_program.py").write_text(program)
    return run_to_end(
        *(sys.executable, "-c", CALL),
        env=os.environ | {"PYTHONPATH": f"{directory}{os.pathsep}{PACKAGES}"},
        preexec_fn=as_child,
    )


@pytest.mark.parametrize(
    ("program", "code"),
    [
        (INTERRUPT + "main = int\n", -signal.SIGINT),
        (f"def main():\n    {INTERRUPT.replace(chr(10), chr(10) + '    ')}return 0\n", 130),
        ("def main(): return 3\n", 3),
        (
            "import atexit, os, signal\n"
            "atexit.register(os.kill, os.getpid(), signal.SIGINT)\n"
            "def main(): return 3\n",
            3,
        ),
    ],
    ids=["imports", "main", "undisturbed", "end"],
)
def test_an_interrupt_leaves_no_traceback(tmp_path, program, code):
    result = call(tmp_path, program)
    assert (result.returncode, result.stderr) == (code, "")


def test_before_the_program_nothing_heavy_is_imported():
    code = (
        "import sys, viability_bounds_pkg.cli.ros_program\n"
        "sys.exit(not {'numpy', 'rclpy', 'numba'}.isdisjoint(sys.modules))"
    )
    environment = os.environ | {"PYTHONPATH": PACKAGES}
    assert (
        subprocess.run([sys.executable, "-c", code], env=environment, check=False).returncode == 0
    )
