# SPDX-License-Identifier: Apache-2.0
"""Entry points of programs: they say in one line that ROS 2 is missing, or end by SIGINT."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable, Mapping
from importlib import import_module

from viability_bounds_pkg.cli.command_line import INTERRUPTED


def run_program(module: str) -> int:
    """Import a module, run its `main` and return its exit code; 130 after SIGINT.

    Args:
        module: dotted name of the module.
    """
    return _run(_load(module))


def run_with_ros(program: str, module: str, libraries: Mapping[str, str] | None = None) -> int:
    """Run a program that imports ROS 2, as `run_program`; return 1 without ROS 2.

    Args:
        program: its name, for the message.
        module: dotted name of the module.
        libraries: others that it needs and that may be missing, and what installs them.
    """
    try:
        main = _load(module)
    except ModuleNotFoundError as error:
        missing = error.name or str(error)
        if missing.split(".")[0] == module.split(".")[0]:
            raise
        if libraries and missing in libraries:
            print(f"{program}: needs '{missing}': {libraries[missing]}", file=sys.stderr)
            return 1
        print(
            f"{program}: this program needs ROS 2 Jazzy (no Python module '{missing}'): "
            "source /opt/ros/jazzy/setup.bash, or see scripts/setup.sh",
            file=sys.stderr,
        )
        return 1
    return _run(main)


def _load(module: str) -> Callable[[], int]:
    """Import a module and return its `main`; until that runs SIGINT just ends the process.

    An import that is interrupted by an exception may fail with any other.
    """
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    # Matrices here are small: more threads only wait for each other, and keep cores busy with it.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    main: Callable[[], int] = import_module(module).main
    return main


def _run(main: Callable[[], int]) -> int:
    try:
        if signal.getsignal(signal.SIGINT) is signal.SIG_DFL:
            signal.signal(signal.SIGINT, signal.default_int_handler)
        code = main()
    except KeyboardInterrupt:
        code = INTERRUPTED
    # A signal while the interpreter ends must not change the exit code, either.
    for each in (signal.SIGINT, signal.SIGTERM):
        signal.signal(each, signal.SIG_IGN)
    return code


def bounds_node() -> int:
    """Run the bounds node."""
    return run_with_ros("bounds_node", "viability_bounds_pkg.node.bounds_node")


def estimator_node() -> int:
    """Run the estimator node."""
    return run_with_ros("estimator_node", "viability_bounds_pkg.node.estimator_node")


def estimate_acceleration_limits() -> int:
    """Run the estimator of acceleration limits."""
    return run_program("viability_bounds_pkg.cli.estimate_acceleration_limits")


def uncertainty_cost() -> int:
    """Run the tool that prints what declared uncertainty costs."""
    return run_program("viability_bounds_pkg.tools.uncertainty_cost")
