# SPDX-License-Identifier: Apache-2.0
"""Entry points of the package's programs, which import nothing heavy themselves."""

from __future__ import annotations

from functools import partial

from viability_bounds_pkg.cli.ros_program import run_program

_EXTRA = dict.fromkeys(
    ("pylibfranka", "franky_sim", "mujoco"),
    "source scripts/setup.sh --franka (Python 3.10 to 3.12)",
)


franka_node = partial(run_program, "franka_bridge.node.franka_node", _EXTRA)
franka_stack = partial(run_program, "franka_bridge.node.franka_stack", _EXTRA)
simulated_fr3 = partial(run_program, "franka_bridge.node.simulated_fr3", _EXTRA)
