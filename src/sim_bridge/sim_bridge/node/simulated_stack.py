# SPDX-License-Identifier: Apache-2.0
"""The simulated robot and the nodes that control it in one process."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from importlib.metadata import entry_points
from types import ModuleType

from sim_bridge.node.bullet_node import BulletNode
from viability_bounds_pkg.exceptions import ArmSafetyError
from viability_bounds_pkg.ros.arm_node import ArmNode
from viability_bounds_pkg.ros.program import report_refusal, run_together, stack_parser

STACKS = "arm_safety.stacks"
"""Group of entry points: modules with KINDS of nodes and a function make_nodes."""


class NoStackError(ArmSafetyError, LookupError):
    """The package that controls robots is not installed."""


def find_stack() -> ModuleType:
    """Return the module of the nodes that control a robot: this package knows messages only.

    Raises:
        NoStackError: there is none.
    """
    for entry in entry_points(group=STACKS):
        module: ModuleType = entry.load()
        return module
    raise NoStackError(
        "no package has nodes that control a robot: install torque_safety_controller"
    )


def main(args: list[str] | None = None) -> int:
    """Run the nodes until they are told to stop."""
    try:
        stack = find_stack()
    except NoStackError as error:
        report_refusal(error)
        return 1

    def make_nodes() -> Iterator[ArmNode]:
        yield BulletNode()
        yield from stack.make_nodes()

    kinds = BulletNode, *stack.KINDS
    parser = stack_parser("simulated_stack", (__doc__ or "").strip(), kinds)
    return run_together(parser, make_nodes, args)


if __name__ == "__main__":
    sys.exit(main())
