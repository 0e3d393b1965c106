# SPDX-License-Identifier: Apache-2.0
"""Bounds, controller and, where it is used, the estimator in one process."""

from __future__ import annotations

import sys
from collections.abc import Iterator

from torque_safety_controller.node.controller_node import ControllerNode
from viability_bounds_pkg.node.bounds_node import BoundsNode
from viability_bounds_pkg.node.estimator_node import EstimatorNode
from viability_bounds_pkg.ros.arm_node import ArmNode
from viability_bounds_pkg.ros.program import run_together, stack_parser

KINDS = (BoundsNode, ControllerNode, EstimatorNode)


def make_nodes() -> Iterator[ArmNode]:
    """Make the nodes between joint states and commands; the estimator if another one needs it."""
    bounds = BoundsNode()
    yield bounds
    controller = ControllerNode()
    yield controller
    if bounds.uses_estimates or controller.uses_estimates:
        yield EstimatorNode()


def main(args: list[str] | None = None) -> int:
    """Run the nodes until they are told to stop."""
    parser = stack_parser("safety_stack", (__doc__ or "").strip(), KINDS)
    return run_together(parser, make_nodes, args)


if __name__ == "__main__":
    sys.exit(main())
