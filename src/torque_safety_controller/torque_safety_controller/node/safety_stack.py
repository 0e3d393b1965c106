# SPDX-License-Identifier: Apache-2.0
"""Bounds, controller and, where it is used, the estimator in one process."""

from __future__ import annotations

import sys
from collections.abc import Iterator

from torque_safety_controller.node.controller_node import ControllerNode
from viability_bounds_pkg.node.bounds_node import BoundsNode
from viability_bounds_pkg.node.estimator_node import EstimatorNode
from viability_bounds_pkg.ros.arm_node import ArmNode
from viability_bounds_pkg.ros.direct_delivery import DirectDelivery
from viability_bounds_pkg.ros.program import run_together, stack_parser
from viability_bounds_pkg.ros.topics import ESTIMATED_JOINT_STATES

KINDS = (BoundsNode, ControllerNode, EstimatorNode)


def make_nodes(direct_delivery: DirectDelivery | None) -> Iterator[ArmNode]:
    """Make the nodes between joint states and commands; the estimator if another one needs it."""
    bounds = BoundsNode(direct_delivery=direct_delivery)
    yield bounds
    controller = ControllerNode(direct_delivery=direct_delivery)
    yield controller
    estimated = ESTIMATED_JOINT_STATES.name
    if any(
        each.resolve_topic_name(estimated) in each.topics_used()[1]
        for each in (bounds, controller)
    ):
        yield EstimatorNode(direct_delivery=direct_delivery)


def main(args: list[str] | None = None) -> int:
    """Run the nodes until they are told to stop."""
    parser = stack_parser("safety_stack", (__doc__ or "").strip(), KINDS)
    return run_together(parser, make_nodes, args)


if __name__ == "__main__":
    sys.exit(main())
