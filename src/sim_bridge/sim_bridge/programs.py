# SPDX-License-Identifier: Apache-2.0
"""Entry points of the package's programs, which import nothing heavy themselves."""

from __future__ import annotations

from functools import partial

from viability_bounds_pkg.cli.ros_program import run_program

_VIEWER = {name: f"pip install {name}" for name in ("viser", "trimesh")}

bullet_node = partial(run_program, "sim_bridge.node.bullet_node")
record_excitation = partial(run_program, "sim_bridge.tools.record_excitation")
scenario_node = partial(run_program, "sim_bridge.node.scenario_node")
simulated_stack = partial(run_program, "sim_bridge.node.simulated_stack")
viewer_node = partial(run_program, "sim_bridge.node.viewer_node", _VIEWER)
