# SPDX-License-Identifier: Apache-2.0
"""A Franka arm and the nodes that control it in one process."""

from __future__ import annotations

import sys

from franka_bridge.node.franka_node import FrankaNode
from viability_bounds_pkg.ros.stack import run_with_stack


def main(args: list[str] | None = None) -> int:
    """Run the nodes until they are told to stop."""
    return run_with_stack(FrankaNode, "franka_stack", __doc__ or "", args)


if __name__ == "__main__":
    sys.exit(main())
