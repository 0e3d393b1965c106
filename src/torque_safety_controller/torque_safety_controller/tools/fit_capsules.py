# SPDX-License-Identifier: Apache-2.0
"""Command line tool that fits capsules to a robot's links and writes them to its parameter file.

Collision avoidance keeps these capsules apart, instead of the links' meshes.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Sequence
from pathlib import Path

from torque_safety_controller.new_robot.capsules import capsule_entries
from torque_safety_controller.parameters.controller_parameters import ControllerConfiguration
from viability_bounds_pkg.cli.command_line import Parser, run_tool
from viability_bounds_pkg.cli.limits_file import CONTROLLER, check_writable, write_whole
from viability_bounds_pkg.parameter_files import ParameterFileError, read_files
from viability_bounds_pkg.robot.configuration import load_model
from viability_bounds_pkg.robot.description import load_geometry

SECTION = "/**/controller_node:\n"
"""Of a parameter file, where capsules are written."""

_LIST = re.compile(r"^    collision_capsules:.*\n(?:      .*\n)*", re.MULTILINE)


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = Parser(
        prog="fit_capsules",
        description="Fit capsules to the collision geometry of a robot's links, and write them to "
        "its parameter file as collision_capsules.",
    )
    parser.add_argument("file", type=Path, help="parameter file of the robot (ROS 2 YAML)")
    return parser.parse_args(arguments)


def with_capsules(text: str, entries: Sequence[str]) -> str:
    """Return the text of a parameter file with its capsules replaced, or added to the section.

    Args:
        text: with the section of the controller.
        entries: of ``collision_capsules``.

    Raises:
        ParameterFileError: there is no such section.
    """
    block = "".join(f'      - "{entry}"\n' for entry in entries)
    block = f"    collision_capsules:\n{block}"
    if _LIST.search(text):
        return _LIST.sub(lambda _: block, text)
    before, section, after = text.partition(SECTION)
    if not section:
        raise ParameterFileError(f"there is no section {SECTION.strip()!r} to write capsules to")
    own = re.match(r"(?:[ #].*\n|\n(?=[ \n]))*", after)
    end = own.end() if own else 0
    return before + section + after[:end] + block + after[end:]


def _run(options: argparse.Namespace) -> int:
    check_writable(options.file)
    config = read_files(ControllerConfiguration, [options.file], CONTROLLER)
    urdf = config.read_urdf()
    model = load_model(config, urdf)
    entries = capsule_entries(model, load_geometry(urdf, model, config.locked))
    write_whole(options.file, with_capsules(options.file.read_text(), entries))
    print(f"{options.file}: {len(entries)} capsules")
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the tool; return its exit code: 0, or 1 for an error."""
    options = _parse(arguments)
    return run_tool("fit_capsules", lambda: _run(options))


if __name__ == "__main__":
    sys.exit(main())
