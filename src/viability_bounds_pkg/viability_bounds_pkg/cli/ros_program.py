# SPDX-License-Identifier: Apache-2.0
"""Entry points of programs that need ROS 2, which say so in one line where it is missing."""

from __future__ import annotations

import sys
from importlib import import_module


def run_with_ros(program: str, module: str) -> int:
    """Run the `main` of a module that imports ROS 2; return its exit code, 1 without ROS 2.

    Args:
        program: its name, for the message.
        module: dotted name of the module.
    """
    try:
        main = import_module(module).main
    except ModuleNotFoundError as error:
        missing = error.name or str(error)
        if missing.split(".")[0] == module.split(".")[0]:
            raise
        print(
            f"{program}: this program needs ROS 2 Jazzy (no Python module '{missing}'): "
            "source /opt/ros/jazzy/setup.bash, or see scripts/setup.sh",
            file=sys.stderr,
        )
        return 1
    code: int = main()
    return code


def bounds_node() -> int:
    """Run the bounds node."""
    return run_with_ros("bounds_node", "viability_bounds_pkg.node.bounds_node")
