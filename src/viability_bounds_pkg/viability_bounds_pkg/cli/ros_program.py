# SPDX-License-Identifier: Apache-2.0
"""Entry points of programs: they say in one line what is not installed, or end by SIGINT."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Mapping
from functools import partial
from importlib import import_module

from viability_bounds_pkg.cli.command_line import INTERRUPTED

_ROS = "source /opt/ros/jazzy/setup.bash, or see scripts/setup.sh"


def run_program(module: str, libraries: Mapping[str, str] | None = None) -> int:
    """Import a module, run its `main` and return its exit code; 130 after SIGINT.

    Args:
        module: dotted name of the module, whose last part is the program's name.
        libraries: what it needs besides ROS 2 and may be missing, and what installs it.
    """
    # An import that is interrupted by an exception may fail with any other.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    # Matrices here are small: more threads only wait for each other, and keep cores busy with it.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    try:
        main = import_module(module).main
    except ModuleNotFoundError as error:
        name = error.name or ""
        if name.split(".")[0] == module.split(".")[0]:
            raise
        program, remedy = module.rpartition(".")[2], {**(libraries or {})}.get(name)
        remedy = remedy or f"this program needs ROS 2 Jazzy: {_ROS}"
        print(f"{program}: no Python module '{name}': {remedy}", file=sys.stderr)
        return 1
    try:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        code: int = main()
    except KeyboardInterrupt:
        code = INTERRUPTED
    # A signal while the interpreter ends must not change the exit code, either.
    for each in (signal.SIGINT, signal.SIGTERM):
        signal.signal(each, signal.SIG_IGN)
    return code


bounds_node = partial(run_program, "viability_bounds_pkg.node.bounds_node")
estimator_node = partial(run_program, "viability_bounds_pkg.node.estimator_node")
estimate_acceleration_limits = partial(
    run_program, "viability_bounds_pkg.cli.estimate_acceleration_limits"
)
