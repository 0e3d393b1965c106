# SPDX-License-Identifier: Apache-2.0
"""A robot's node and the nodes that control it in one process."""

from __future__ import annotations

from collections.abc import Iterator
from importlib.metadata import entry_points
from types import ModuleType

from viability_bounds_pkg.exceptions import ArmSafetyError
from viability_bounds_pkg.ros.arm_node import ArmNode
from viability_bounds_pkg.ros.program import report_refusal, run_together, stack_parser

STACKS = "arm_safety.stacks"
"""Group of entry points: modules with KINDS of nodes and a function make_nodes."""


class NoStackError(ArmSafetyError, LookupError):
    """The package that controls robots is not installed."""


def find_stack() -> ModuleType:
    """Return the module of the nodes that control a robot: its package knows messages only.

    Raises:
        NoStackError: there is none.
    """
    for entry in entry_points(group=STACKS):
        module: ModuleType = entry.load()
        return module
    raise NoStackError(
        "no package has nodes that control a robot: install torque_safety_controller"
    )


def run_with_stack(
    robot: type[ArmNode], name: str, description: str, args: list[str] | None = None
) -> int:
    """Run a robot's node and those that control it until they are told to stop.

    Args:
        robot: makes the robot's node.
        name: of the program.
        description: of the program, for its help.
        args: the command line; None for that of the process.

    Returns:
        The exit code, as `run_together`.
    """
    try:
        stack = find_stack()
    except NoStackError as error:
        report_refusal(error)
        return 1

    def make_nodes() -> Iterator[ArmNode]:
        yield robot()
        yield from stack.make_nodes()

    parser = stack_parser(name, description.strip(), (robot, *stack.KINDS))
    return run_together(parser, make_nodes, args)
