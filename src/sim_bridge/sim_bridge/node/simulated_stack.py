# SPDX-License-Identifier: Apache-2.0
"""The simulated robot and the nodes that control it in one process."""

from __future__ import annotations

import sys

from sim_bridge.node.bullet_node import BulletNode
from viability_bounds_pkg.ros.stack import run_with_stack


def main(args: list[str] | None = None) -> int:
    """Run the nodes until they are told to stop."""
    return run_with_stack(BulletNode, "simulated_stack", __doc__ or "", args)


if __name__ == "__main__":
    sys.exit(main())
