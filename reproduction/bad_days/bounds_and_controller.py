# SPDX-License-Identifier: Apache-2.0
"""Bounds and controller in one process, as in `safety_stack`; an estimator runs in its own."""

from __future__ import annotations

import sys
from collections.abc import Iterator

from torque_safety_controller.node.controller_node import ControllerNode
from viability_bounds_pkg.node.bounds_node import BoundsNode
from viability_bounds_pkg.ros.arm_node import ArmNode
from viability_bounds_pkg.ros.direct_delivery import DirectDelivery
from viability_bounds_pkg.ros.program import run_together, stack_parser


def make_nodes(direct_delivery: DirectDelivery) -> Iterator[ArmNode]:
    """Make both nodes."""
    yield BoundsNode(direct_delivery=direct_delivery)
    yield ControllerNode(direct_delivery=direct_delivery)


if __name__ == "__main__":
    parser = stack_parser("bounds_and_controller", __doc__, (BoundsNode, ControllerNode))
    sys.exit(run_together(parser, make_nodes))
